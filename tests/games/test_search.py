"""The search: a plain Python one beside it, perfect values, signs, legal moves only."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tic_tac_toe_lines as lines
from thorndike.errors import UserError
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.search import SEARCHES, SearchSettings, by_playouts, search
from thorndike.games.tic_tac_toe import TIC_TAC_TOE

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY = jax.random.key(0)
POSITION = (0b000010001, 0b100000010)
"""X on the first and fifth square, O on the second and ninth; X to move."""


def made_up(pieces):
    """Numbers that stand for a network: logits of the moves and a value, by the position alone."""
    seed = pieces[0] * 7.0 + pieces[1] * 13.0
    logits = jnp.sin(seed + jnp.arange(9, dtype=jnp.float32) * 1.7)
    return logits, 0.8 * jnp.sin(seed * 0.37 + 1.0)


def evaluate_made_up(params, positions, key):
    del params, key
    return jax.vmap(lambda p: made_up(p.astype(jnp.float32)))(positions.pieces)


class Node:
    """A node of the plain tree; values are the mover's."""

    def __init__(self, pieces):
        self.pieces, self.visits, self.children = pieces, 1, {}
        self.ended = lines.result(pieces)
        logits, value = made_up(np.array(pieces, np.float32))
        self.total = 0.0 if self.ended is not None else float(value)
        legal = lines.moves(pieces)
        weights = np.exp(np.asarray(logits, np.float64))
        self.prior = {move: weights[move] / sum(weights[legal]) for move in legal}

    def best(self, c_init, c_base=19652):
        def score(move):
            child = self.children.get(move)
            explore = math.sqrt(self.visits) * (c_init + math.log((self.visits + c_base + 1) / c_base)) * self.prior[move]
            if child is None:
                return explore
            return (self.worth(child) + 1) / 2 + explore / (child.counted + 1)

        return max(self.prior, key=score)

    def worth(self, child):
        """Of the move to ``child``, for the mover here."""
        if child.ended is not None:
            return child.ended if lines.mover(self.pieces) == 0 else -child.ended
        return -child.total / child.visits


def plain_search(pieces, simulations, c_init):
    """PUCT in the words of the paper."""
    root = Node(pieces)
    for _ in range(simulations):
        node, path = root, []
        while True:
            move = node.best(c_init)
            path.append((node, move))
            if move not in node.children:
                child = node.children[move] = Node(lines.after(node.pieces, move))
                child.counted = 0
                break
            node = node.children[move]
            if node.ended is not None:
                break
        leaf = path[-1][0].children[path[-1][1]]
        value = leaf.total / leaf.visits
        if leaf.ended is not None:
            parent = path[-1][0]
            value = -parent.worth(leaf)
        for parent, move in reversed(path):
            value = -value
            child = parent.children[move]
            child.counted += 1
            parent.visits += 1
            parent.total += value
    return root


@pytest.mark.parametrize("simulations", [8, 40])
def test_puct_is_the_plain_search(simulations):
    settings = SearchSettings("puct", simulations, c_puct=1.25)
    found = search(TIC_TAC_TOE, evaluate_made_up, settings, (), lines.batch([POSITION]), KEY, explore=False)
    root = plain_search(POSITION, simulations, 1.25)
    visits = [root.children[move].counted if move in root.children else 0 for move in range(9)]
    assert found.visits[0].tolist() == visits
    assert found.value[0] == pytest.approx(root.total / root.visits, abs=1e-5)
    np.testing.assert_allclose(found.policy[0], np.array(visits) / simulations, atol=1e-6)
    assert found.action[0] == np.argmax(visits)


@pytest.mark.parametrize("kind", SEARCHES)
def test_values_are_the_movers_and_a_win_at_hand_is_taken(kind):
    # X has two in a row; O too. Whoever moves wins at once, so both see 1.
    both = (0b000000011, 0b000011000)
    of_second = (0b100000011, 0b000011000)
    settings = SearchSettings(kind, 64)
    found = search(TIC_TAC_TOE, lines.perfect_evaluation(), settings, (), lines.batch([both, of_second]), KEY, explore=False)
    assert found.action.tolist() == [2, 5]
    assert (found.value > 0.2).all()


@pytest.mark.parametrize("kind", SEARCHES)
@pytest.mark.parametrize("explore", [False, True])
def test_no_move_that_is_not_legal_is_chosen_taught_or_tried(kind, explore):
    def evaluate(params, positions, key):
        """Prefers the first column, which is full."""
        del params, key
        return jnp.tile(jnp.where(jnp.arange(7) == 0, 50.0, 0.0)[None], (positions.pieces.shape[0], 1)), jnp.zeros(
            positions.pieces.shape[0]
        )

    position = CONNECT_FOUR.init(KEY)
    for _ in range(6):
        position = CONNECT_FOUR.step(position, jnp.int32(0), KEY)
    positions = jax.tree.map(lambda x: jnp.tile(x[None], (16, *[1] * x.ndim)), position)
    settings = SearchSettings(kind, 24)
    found = jax.jit(lambda p, key: search(CONNECT_FOUR, evaluate, settings, (), p, key, explore=explore))(positions, jax.random.key(5))
    assert (found.action != 0).all() and (found.visits[:, 0] == 0).all()
    np.testing.assert_allclose(found.policy[:, 0], 0.0, atol=1e-7)
    np.testing.assert_allclose(found.policy.sum(axis=1), 1.0, atol=1e-5)
    if explore:
        assert len(np.unique(np.asarray(found.visits), axis=0)) > 1, "noise makes searches differ"


def test_playouts_find_the_move_that_wins_and_the_one_that_must_be_stopped():
    key = jax.random.key(1)
    settings = SearchSettings("puct", 200)
    choose = jax.jit(partial(search, TIC_TAC_TOE, by_playouts(TIC_TAC_TOE), settings, (), explore=False))
    # X to move: wins with the third of its row; and has to stop O's row.
    found = choose(lines.batch([(0b000000011, 0b000011000), (0b100000001, 0b000011000)]), key)
    assert found.action.tolist() == [2, 5]


def test_a_game_with_dice_is_refused():
    with pytest.raises(UserError, match="two players without dice"):
        search(TIC_TAC_TOE._replace(has_chance=True), evaluate_made_up, SearchSettings(), (), lines.batch([POSITION]), KEY, explore=False)
