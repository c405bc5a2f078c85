"""Ownership and score heads: how games ended is found from every one of their positions, seen by its mover, turned with the board."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from squares_game import SQUARES
from thorndike.algorithms.alphazero import Config, alphazero, alphazero_loss
from thorndike.errors import UserError
from thorndike.games.board_heads import HeadTargets, HeadWeights, endings_of, head_losses
from thorndike.games.environment import game_environment
from thorndike.games.packing import packing
from thorndike.games.self_play import Batch, as_batch
from thorndike.games.settings import GameSettings
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.games.window import empty_window, into_window
from thorndike.networks.board import TOWERS, BoardHeads, board_network
from thorndike.networks.network import Network
from thorndike.replay.self_play import sample_self_play
from thorndike.types import Rollout

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY = jax.random.key(0)
GAMES, MOVES, ROUNDS, RESIGNS = 5, 3, 16, 9
LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))


@pytest.fixture(scope="module")
def played(quick_compile):
    """A window of random games whose rows say in their policy when and where they were played; and, by step and game, the pieces, the move
    and whether it ended the game; and a step."""
    environment = game_environment(SQUARES, GAMES, GameSettings(opening_share=0.5, opening_plies=2))
    step, remember = jax.jit(environment.step), jax.jit(lambda window, rollout: into_window(SQUARES, window, rollout))
    unpack = jax.jit(jax.vmap(packing(SQUARES).unpack))
    random, noise = np.random.default_rng(0), environment.draw(jax.random.key(1), MOVES * ROUNDS)
    window, history, rows, (state, obs) = empty_window(SQUARES, 30, MOVES, GAMES, endings=True), [], [], environment.init(KEY)
    for when in range(MOVES * ROUNDS):
        action = np.array([random.choice(np.flatnonzero(row)) for row in np.asarray(obs["action_mask"])], np.int32)
        action = np.where(random.random(GAMES) < 0.06, RESIGNS, action).astype(np.int32)
        state, result = step(state, action, jax.tree.map(lambda x, when=when: x[when], noise))
        policy = np.zeros((GAMES, 9), np.float32)
        policy[:, 0], policy[:, 1] = when, np.arange(GAMES)
        extras = {"policy": policy, "policy_weight": np.ones(GAMES, np.float32), "resigns": np.zeros(GAMES, bool)}
        rows.append(Rollout(obs, action, extras, result, ()))
        pieces = np.asarray(unpack(obs["position"]).pieces)
        boards = [["X" if x >> i & 1 else "O" if o >> i & 1 else "" for i in range(9)] for x, o in pieces]
        history.append(list(zip(boards, action.tolist(), np.asarray(result.terminated).tolist(), strict=True)))
        obs = result.obs
        if len(rows) == MOVES:
            window = remember(window, jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows))
            rows.clear()
    return window, history, result


def slow_ending(history, when, game):
    """Whose the squares were after the last move of a row's game; None if it was resigned, drawn or is not over."""
    for board, action, over in (row[game] for row in history[when:]):
        if action == RESIGNS:
            return None
        if over:
            last = [*board]
            last[action] = "X" if last.count("X") == last.count("O") else "O"
            winner = next((last[a] for a, b, c in LINES if last[a] and last[a] == last[b] == last[c]), None)
            return None if winner is None else [(1 if piece == "X" else -1) * (piece == winner) for piece in last]
    return None


def test_every_row_finds_the_ending_of_its_own_game_as_its_mover_sees_it(played):
    window, history, _ = played
    rows = sample_self_play(window, KEY, 600)
    batch = as_batch(SQUARES, rows, symmetries=False)
    seen, counted = set(), 0
    for i, (when, game) in enumerate(np.asarray(rows.policy)[:, :2].astype(int).tolist()):
        board, expected = history[when][game][0], slow_ending(history, when, game)
        sign = 1 if board.count("X") == board.count("O") else -1
        drawn = expected is None and bool(rows.known[i]) and float(rows.outcome[i]) == 0
        # A drawn game has nobody's squares, which agrees with its result.
        assert bool(batch.ending.weight[i]) == (expected is not None or drawn), (when, game)
        if batch.ending.weight[i]:
            owner = np.zeros(9) if expected is None else sign * np.array(expected)
            np.testing.assert_array_equal(batch.ending.ownership[i].reshape(-1), owner)
            assert float(batch.ending.score[i]) == owner.sum() and np.sign(owner.sum()) == float(rows.outcome[i])
            counted += 1
        seen.add((when, game))
    assert len(seen) > 0.9 * window.rows.player.size and 0.5 < counted / 600 < 0.95


def test_squares_turn_with_the_board_and_only_there(played):
    rows = sample_self_play(played[0], KEY, 64)
    plain, way = as_batch(SQUARES, rows, symmetries=False), as_batch(SQUARES, rows, symmetries=True)
    decided = np.asarray(plain.ending.weight) > 0
    lopsided = 0
    for i in np.flatnonzero(decided):
        for before, after in ((plain.board[i], way.board[i]), (plain.ending.ownership[i][..., None], way.ending.ownership[i][..., None])):
            expected = before if i % 8 == 0 else SQUARES.symmetries[i % 8 - 1].observation(before)
            np.testing.assert_array_equal(after, expected)
        lopsided += not np.array_equal(plain.ending.ownership[i], way.ending.ownership[i])
        # Pieces on the board stay there to the end, so the mover owns the squares of his if he wins.
        wins = 1 if plain.ending.score[i] > 0 else -1
        winner = way.board[i][..., 0 if wins > 0 else 1]
        assert plain.ending.score[i] == 0 or (np.asarray(way.ending.ownership[i])[np.asarray(winner) > 0] == wins).all()
    assert lopsided > 10
    np.testing.assert_array_equal(plain.ending.score, way.ending.score)


def test_compensation_counts_for_player_1_and_what_squares_did_not_decide_is_left_out(played):
    rows = sample_self_play(played[0], KEY, 100)
    given, without = as_batch(SQUARES._replace(komi=2.5), rows, False).ending, as_batch(SQUARES, rows, False).ending
    np.testing.assert_array_equal(given.score - without.score, np.where(np.asarray(rows.player) == 0, -2.5, 2.5))
    # X at the top of the left and middle columns, O below: X wins on the third square, by 3 squares.
    before = TIC_TAC_TOE.init(KEY)._replace(pieces=jnp.array([0b000000011, 0b000011000], jnp.int32))
    after = packing(SQUARES).pack(SQUARES.step(before, jnp.int32(2), KEY))
    for komi, counts in ((0.0, True), (2.5, True), (3.5, False)):
        ended = played[2]._replace(next_obs={"position": jnp.tile(after, (1, 2, 1))})
        found = endings_of(SQUARES._replace(komi=komi), Rollout((), jnp.array([[2, RESIGNS]]), {}, ended, ()))
        assert found.counts.tolist() == [[counts, False]] and found.owner[0, 0].tolist() == [[1, 1, 1], [0, 0, 0], [0, 0, 0]]


def test_the_losses_are_those_of_a_slow_loop():
    random = np.random.default_rng(0)
    count, size = 4, (3, 2)
    logits, score = random.normal(size=(count, *size)), 3 * random.normal(size=count)
    owner, points, weight = random.integers(-1, 2, (count, *size)), random.integers(-6, 7, count), np.array([1, 0, 1, 1])
    of_squares = of_score = 0.0
    for i in range(count):
        for r, c in itertools.product(range(3), range(2)):
            mine, chance = (owner[i, r, c] + 1) / 2, 1 / (1 + np.exp(-logits[i, r, c]))
            of_squares -= weight[i] / 3 / 6 * (mine * np.log(chance) + (1 - mine) * np.log(1 - chance))
        off = abs(score[i] - points[i] / np.sqrt(6))
        of_score += weight[i] / 3 * (off**2 / 2 if off < 1 else off - 0.5)
    said, targets = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (BoardHeads(logits, score), HeadTargets(owner, points, weight)))
    loss, metrics = head_losses(said, targets, HeadWeights(2.0, 0.5))
    assert float(metrics["train/ownership_loss"]) == pytest.approx(of_squares, rel=1e-5)
    assert float(metrics["train/score_loss"]) == pytest.approx(of_score, rel=1e-5)
    assert float(loss) == pytest.approx(2 * of_squares + of_score / 2, rel=1e-5)
    alone, found = head_losses(BoardHeads(said.ownership, None), targets, HeadWeights(2.0, 0.0))
    assert float(alone) == pytest.approx(2 * of_squares, rel=1e-5) and set(found) == {"train/ownership_loss"}
    network = Network(lambda key, board: (), lambda params, board: (jnp.zeros((count, 5)), jnp.zeros(count), said))
    ones = jnp.ones(count)
    batch = Batch(jnp.zeros((count, *size, 1)), jnp.ones((count, 5), bool), jnp.full((count, 5), 0.2), ones, ones, ones, targets)
    whole, metrics = alphazero_loss((), batch, network, 1.0, HeadWeights(2.0, 0.5))
    assert float(whole) == pytest.approx(np.log(5) + np.log(2) + float(loss), rel=1e-5) and float(metrics["train/loss"]) == float(whole)


@pytest.mark.parametrize("tower", TOWERS)
def test_heads_sit_on_every_tower_and_change_nothing_else(tower):
    board = jax.random.bernoulli(KEY, 0.4, (3, 6, 7, 2)).astype(jnp.float32)
    plain, network = board_network(45, tower, 16, 1), board_network(45, tower, 16, 1, ("ownership", "score"))
    bare, params = plain.init(KEY, board), network.init(KEY, board)
    assert set(params) - set(bare) == {"ownership", "score"}
    for one, other in zip(plain.apply(bare, board), network.apply(params, board), strict=False):
        np.testing.assert_array_equal(one, other)
    heads = network.apply(params, board)[2]
    assert heads.ownership.shape == (3, 6, 7) and heads.score.shape == (3,)
    assert board_network(45, tower, 16, 1, ("score",)).apply(params, board)[2].ownership is None
    for square in ((0, 0), (5, 6), (2, 3)):
        gradient = jax.grad(lambda p, at=square: network.apply(p, board)[2].ownership[:, at[0], at[1]].sum())(params)
        policy = [layer["kernel"] for name, layer in gradient.items() if name.startswith("policy")]
        assert float(jnp.abs(gradient["ownership"]["kernel"]).sum()) > 0 and all(float(jnp.abs(kernel).sum()) == 0 for kernel in policy)
        assert policy


def test_heads_are_refused_where_squares_decide_nothing_or_are_others():
    spec = game_environment(TIC_TAC_TOE, 2).spec
    for config in (Config(ownership_coef=1.0), Config(score_coef=0.1)):
        with pytest.raises(UserError, match=r"tic_tac_toe is not decided by whose its squares are.*leave ownership_coef and"):
            alphazero(config, spec)
    flat = SQUARES._replace(ownership=lambda position: SQUARES.ownership(position).reshape(1, 9))
    with pytest.raises(UserError, match=r"has the shape \(1, 9\), but its observation is 3 by 3"):
        alphazero(Config(score_coef=0.1), game_environment(flat, 2).spec)
