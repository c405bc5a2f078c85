"""Players of our own: random moves, plain search, and a trained policy, here one that knows nothing but what it is told."""

from collections import Counter

import jax
import jax.numpy as jnp
import pytest

from games.rules import KEY, Compiled
from thorndike.environments.wrappers import chain
from thorndike.errors import UserError
from thorndike.games.agent_player import agent_player
from thorndike.games.game import Turn, named_action
from thorndike.games.players import mcts_player, random_player
from thorndike.games.registry import game
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
