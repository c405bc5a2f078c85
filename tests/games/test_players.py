"""Players of our own: random moves, plain search, and a trained policy, here one that knows nothing but what it is told."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from games.rules import KEY, Compiled
from games.test_search import evaluate_made_up
from thorndike.api.building import build_algorithm
from thorndike.environments.wrappers import chain
from thorndike.errors import UserError
from thorndike.games import cut_search
from thorndike.games.agent_player import agent_player
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.game import Stopped, Turn, named_action
from thorndike.games.players import mcts_player, random_player
from thorndike.games.plies import positions_before
from thorndike.games.registry import game
from thorndike.games.search import SEARCHES, SearchSettings, search
from thorndike.networks.masking import MASK
from thorndike.types import Algorithm, Needs


@pytest.fixture(scope="module")
def board(quick_compile):
    return Compiled(game("tic_tac_toe"))


def turn(board, names):
    position, moves = board.init(KEY), []
    for name in names.split():
        moves.append(named_action(board.game, position, name))
        position = board.play(position, moves[-1])
    return Turn(board.game, position, tuple(moves))


def stub(probabilities):
    """A policy whose value is always 0."""

    def unused(*_):
        raise AssertionError

    return Algorithm(
        init=unused,
        actor=unused,
        memory=lambda size: (),
        draw=unused,
        act=unused,
        greedy=unused,
        value=lambda actor, obs: jnp.zeros(obs["board"].shape[0]),
        update=unused,
        observe=unused,
        needs=Needs(1, True),
        probabilities=probabilities,
    )


def prefers_c3(actor, memory, obs):
    del memory
    return jax.nn.softmax(jnp.where(obs[MASK] > 0, actor, -1e9))


CANNOT_PLAY = stub(None)
ACTOR = jnp.zeros(9).at[2].set(1.0)
"""Action 2 is c3."""


def test_random_moves_are_legal_and_equally_likely(board):
    player = random_player(1)
    asked = turn(board, "a1 b2")
    counts = Counter(player.choose(asked).action for _ in range(700))
    assert set(counts) == set(range(9)) - set(asked.moves)
    # 100 each are expected; their spread is 9.3.
    assert all(60 < count < 140 for count in counts.values())


def test_search_sees_wins_and_threats_and_says_what_it_expects(board):
    player = mcts_player(board.game, 200, seed=1)
    choice = player.choose(turn(board, "a1 a2 b1 b2"))
    assert board.game.action_name(None, choice.action) == "c1"
    assert choice.win_probability > 0.85
    assert sum(choice.visits.values()) == 200
    assert max(choice.visits, key=choice.visits.get) == choice.action
    assert choice.principal_variation == (choice.action,)
    threatened = player.choose(turn(board, "a1 b2 b1"))
    assert board.game.action_name(None, threatened.action) == "c1"
    line = threatened.principal_variation
    assert line[0] == threatened.action
    assert len(set(line)) == len(line) > 1
    assert not set(line) & set(turn(board, "a1 b2 b1").moves)


def test_a_policy_plays_its_likeliest_move_and_searches_when_told(board):
    asked = turn(board, "a1 a2 b1 b2")
    plain = agent_player("stub", board.game, stub(prefers_c3), chain(), ACTOR, (), {}, 0).choose(asked)
    assert board.game.action_name(None, plain.action) == "c3"
    assert (plain.win_probability, plain.visits) == (0.5, None)
    deep = agent_player("stub", board.game, stub(prefers_c3), chain(), ACTOR, (), {"search": "puct", "c_puct": 2.0}, 64).choose(asked)
    assert board.game.action_name(None, deep.action) == "c1"
    assert sum(deep.visits.values()) == 64
    assert deep.win_probability > 0.5


def test_the_likeliest_move_is_a_legal_one(board):
    player = agent_player("stub", board.game, stub(prefers_c3), chain(), ACTOR, (), {}, 0)
    assert player.choose(turn(board, "c3")).action != 2


def test_who_tells_no_probabilities_cannot_play(board):
    with pytest.raises(UserError, match="stub tells no probabilities of moves"):
        agent_player("stub", board.game, CANNOT_PLAY, chain(), ACTOR, (), {})


def counting(actor, memory, obs):
    """Remembers every position that it decided in: here how many, and the sum of the stones on them."""
    del actor
    return memory + jnp.stack([jnp.ones(obs["board"].shape[0]), jnp.sum(obs["board"], axis=(1, 2, 3))], axis=1)


@pytest.fixture
def remembering(board):
    """Plays the move that is its memory's number, counted among the legal ones; and what it was asked with."""
    asked = []

    def told(memory):
        asked.append(np.asarray(memory).tolist())

    def probabilities(actor, memory, obs):
        jax.debug.callback(told, memory[0])
        places = jnp.cumsum(obs[MASK], axis=1) - 1
        return ((places == memory[:, :1]) & (obs[MASK] > 0)).astype(jnp.float32)

    algorithm = stub(probabilities)._replace(
        memory=lambda size: jnp.zeros((size, 2)),
        draw=lambda key, steps: jnp.zeros((steps, 4)),
        greedy=lambda actor, memory, obs, noise: (counting(actor, memory, obs), None, {}),
    )
    return agent_player("stub", board.game, algorithm, chain(), ACTOR, (), {}, 64), asked


def test_a_policy_with_memory_follows_the_game_of_both_sides(board, remembering):
    player, asked = remembering
    names = "a1 b2 c3 a3"
    for length, expected in ((4, 4), (2, 2), (3, 3), (0, 0)):
        # Moves were taken back in between.
        choice = player.choose(turn(board, " ".join(names.split()[:length])))
        legal = [action for action in range(9) if action not in turn(board, " ".join(names.split()[:length])).moves]
        assert choice.action == legal[expected]
        assert choice.win_probability is None and choice.visits is None, "it is not searched"
    player.choose(turn(board, "a1 c3 b2"))
    jax.effects_barrier()
    assert [each[0] for each in asked] == [4, 2, 3, 0, 3]
    # Positions before move 1, 2, 3 hold 0, 1 and 2 stones.
    assert asked[2][1] == sum(float(np.sum(board.game.observe(position))) for position in positions_before(turn(board, "a1 b2 c3")))


def test_of_dice_the_positions_decide_what_is_remembered(board):
    dice = board.game._replace(has_chance=True)
    position, moves = board.init(KEY), (4,)
    algorithm = stub(prefers_c3)._replace(
        memory=lambda size: jnp.zeros((size, 2)),
        draw=lambda key, steps: jnp.zeros((steps, 4)),
        greedy=lambda actor, memory, obs, noise: (counting(actor, memory, obs), None, {}),
        probabilities=lambda actor, memory, obs: jax.nn.one_hot(memory[:, 1].astype(int), 9),
    )
    player = agent_player("stub", dice, algorithm, chain(), ACTOR, (), {})
    # As if another throw had led elsewhere before the same move.
    for before in ("", "a1 b1 c1"):
        first = turn(board, before).position
        expected = int(np.sum(board.game.observe(first)))
        assert player.choose(Turn(dice, position, moves, (first,))).action == expected
    with pytest.raises(UserError, match=r"give Turn\.earlier"):
        player.choose(Turn(dice, position, moves))


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_search_in_parts_finds_what_a_whole_one_finds(board, kind, monkeypatch):
    settings, position, key = SearchSettings(kind, 50), turn(board, "a1 b2").position, jax.random.key(3)
    at_once = jax.jit(lambda positions: search(board.game, evaluate_made_up, settings, (), positions, key, explore=False))
    whole = at_once(jax.tree.map(lambda leaf: leaf[None], position))
    monkeypatch.setattr(cut_search, "_FIRST", 7)
    asked = []
    look = cut_search.cut_search(board.game, evaluate_made_up, settings)
    found = look((), position, key, lambda: bool(asked.append(1)))
    for name, ours, theirs in zip(whole._fields, found, whole, strict=True):
        # Programs of another shape round otherwise.
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, err_msg=name)
    assert len(asked) > 2


def test_a_search_that_is_stopped_ends_long_before_its_last_simulation(board):
    player, left = mcts_player(board.game, 200_000, seed=1), [3]

    def stopped():
        left[0] -= 1
        return left[0] == 0

    with pytest.raises(Stopped):
        player.choose(turn(board, "a1")._replace(stopped=stopped))
    assert left == [0], "it asked twice in vain, before the first two parts"


def test_a_memory_that_moves_do_not_depend_on_is_none(board):
    """AlphaZero's counts moves."""
    counts = stub(prefers_c3)._replace(memory=lambda size: jnp.zeros((size, 1)))
    choice = agent_player("stub", board.game, counts, chain(), ACTOR, (), {}, 8).choose(turn(board, "a1 a2 b1 b2"))
    assert sum(choice.visits.values()) == 8


def test_a_network_with_memory_plays_what_it_would_have_played_in_training(board):
    settings = {"memory": "gru", "memory_size": 4, "net_arch": (4,), "n_steps": 4, "batch_size": 4}
    algorithm = build_algorithm("ppo", settings, game_environment(board.game, 2).spec, None)
    actor = jax.tree.map(lambda leaf: 3 * leaf, algorithm.actor(jax.jit(algorithm.init)(KEY)))
    player, names = agent_player("gru", board.game, algorithm, chain(), actor, (), {}, 64), "a1 b2 c3 a3 b1"
    noise = jax.tree.map(lambda leaf: leaf[0, :1], algorithm.draw(KEY, 1))
    greedy, memory = jax.jit(algorithm.greedy), algorithm.memory(1)
    asked = turn(board, names)
    for number, position in enumerate((*positions_before(asked), asked.position)):
        obs = jax.tree.map(lambda leaf: leaf[None], observed_position(board.game, position))
        memory, action, _ = greedy(actor, memory, obs, noise)
        if number in (0, 3, 5):
            assert player.choose(turn(board, " ".join(names.split()[:number]))).action == int(action[0])
