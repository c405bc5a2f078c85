"""Evaluation against an opponent: pairs of games with colours swapped, results as rewards, settings checked."""

import numpy as np
import pytest

from thorndike.environments import registry
from thorndike.errors import UserError
from thorndike.games.against import AgainstOpponent
from thorndike.games.environment import game_environment
from thorndike.games.settings import GameSettings, game_settings
from thorndike.games.tic_tac_toe import TIC_TAC_TOE

pytestmark = pytest.mark.usefixtures("quick_compile")


def stones(obs) -> int:
    return int(obs["board"].sum())


def test_games_come_in_pairs_of_one_opening_with_colours_swapped():
    env = AgainstOpponent(TIC_TAC_TOE, GameSettings(eval_opening_plies=2))
    obs, _ = env.reset(seed=3)
    firsts, random = [], np.random.default_rng(0)
    for _ in range(6):
        firsts.append(stones(obs))
        assert env.observation_space.contains(obs)
        terminated, moves = False, 0
        while not terminated:
            before = stones(obs)
            obs, reward, terminated, truncated, _ = env.step(random.choice(np.flatnonzero(obs["action_mask"])))
            moves += 1
            assert not truncated and reward in (-1.0, 0.0, 1.0) and (terminated or reward == 0)
            assert stones(obs) - before in ((1, 2) if terminated else (2,))
        obs, _ = env.reset()
    # The agent moves first in the opening's position in one game of a pair, and after the opponent's move in the other.
    assert all(abs(first - second) == 1 for first, second in zip(firsts[::2], firsts[1::2], strict=True))
    again, _ = AgainstOpponent(TIC_TAC_TOE, GameSettings(eval_opening_plies=2)).reset(seed=3)
    assert stones(again) == firsts[0]


def test_a_move_that_is_not_legal_loses():
    env = AgainstOpponent(TIC_TAC_TOE, GameSettings(eval_opening_plies=4))
    obs, _ = env.reset(seed=0)
    while stones(obs) == 0:
        obs, _ = env.reset()
    _, reward, terminated, _, _ = env.step(int(np.flatnonzero(obs["action_mask"] == 0)[0]))
    assert (reward, terminated) == (-1.0, True)


@pytest.mark.slow
def test_plain_search_beats_random_moves():
    env = AgainstOpponent(TIC_TAC_TOE, GameSettings(opponent="mcts", opponent_simulations=50, eval_opening_plies=0))
    random, results = np.random.default_rng(0), []
    obs, _ = env.reset(seed=0)
    while len(results) < 40:
        obs, reward, terminated, _, _ = env.step(random.choice(np.flatnonzero(obs["action_mask"])))
        if terminated:
            results.append(reward)
            obs, _ = env.reset()
    assert np.mean(results) < -0.7


@pytest.mark.parametrize(
    "given, message",
    [
        ({"oponent": "mcts"}, "did you mean 'opponent'"),
        ({"opponent": "gnugo"}, "unknown opponent 'gnugo'"),
        ({"opening_share": 2}, "from 0 to 1"),
        ({"opening_plies": -1}, "0 or more"),
        ({"eval_opening_plies": 1.5}, "0 or more"),
        ({"opponent_simulations": 0}, "at least 1"),
    ],
)
def test_settings_that_cannot_be_are_one_line(given, message):
    with pytest.raises(UserError, match=message):
        game_settings("connect_four", given)


def test_an_opponent_that_searches_is_refused_before_training_where_nothing_is_searched():
    for id in ("backgammon", "2048"):
        with pytest.raises(UserError, match="mcts plays games of two players without dice"):
            game_settings(id, {"opponent": "mcts"})
        game_settings(id, {"opponent": "random"})
    for own in (TIC_TAC_TOE._replace(has_chance=True), TIC_TAC_TOE._replace(num_players=1)):
        with pytest.raises(UserError, match="mcts plays games of two players without dice"):
            game_environment(own, 2, GameSettings(opponent="mcts"))


def test_a_game_is_chosen_by_id_by_name_and_as_it_is():
    assert registry.resolve("connect_four").engine == "native"
    named = registry.resolve("thorndike.games.tic_tac_toe:TIC_TAC_TOE")
    assert registry.game_of(named) is TIC_TAC_TOE
    given = registry.resolve(TIC_TAC_TOE, env_kwargs={"opening_share": 0.0})
    built = registry.build_native(given, 3)
    assert (built.spec.id, built.spec.num_envs, built.spec.game) == ("tic_tac_toe", 3, TIC_TAC_TOE)
    assert isinstance(registry.reference(given), AgainstOpponent)
    assert registry.game_of(registry.resolve("CartPole-v1")) is None
    for named_or_given in ("connect_four", TIC_TAC_TOE):
        with pytest.raises(UserError, match="ends by its rules: leave max_episode_steps out"):
            registry.resolve(named_or_given, max_episode_steps=5)
    with pytest.raises(UserError, match="is a game, which is compiled"):
        registry.resolve("connect_four", engine="gymnasium")
    with pytest.raises(UserError, match="thorndike play connect_four"):
        registry.reference(registry.resolve("connect_four"), render_mode="rgb_array")
