"""The quick answer about an environment's name agrees with the slow one."""

import gymnasium
import pytest

from thorndike.cli import environment_names
from thorndike.cli.environment_names import check_environment
from thorndike.environments.host.envpool_ids import pool_ids
from thorndike.environments.native import NATIVE
from thorndike.errors import UserError
from thorndike.games.registry import game_ids


def check(name):
    check_environment(name, engine="auto", env_kwargs={}, max_episode_steps=None)


def test_the_ids_read_from_text_are_those_gymnasium_registers():
    # Other packages add their own ids as soon as a test imports them: gymnasium_robotics even without a namespace.
    own = {id for id, spec in gymnasium.registry.items() if spec.namespace is None and str(spec.entry_point).startswith("gymnasium.")}
    known = environment_names._ids_in_the_text()
    assert own <= known
    assert known - own <= set(NATIVE) | set(game_ids()) | pool_ids()


def test_alphazero_is_for_games():
    with pytest.raises(UserError, match="learns games of two players, such as connect_four, and CartPole-v1 is none"):
        check_environment("CartPole-v1", engine="auto", env_kwargs={}, max_episode_steps=None, algorithm="alphazero")
    check_environment("connect_four", engine="auto", env_kwargs={}, max_episode_steps=None, algorithm="alphazero")


@pytest.mark.parametrize(
    ("name", "close"),
    [("conect_four", "connect_four"), ("CartPol-v1", "CartPole-v1"), ("Taxi-v33", "Taxi-v3"), ("halfcheetah-v5", "HalfCheetah-v5")],
)
def test_a_misspelt_id_gets_the_nearest_one(name, close):
    with pytest.raises(UserError, match=f"unknown environment '{name}'; did you mean '{close}'"):
        check(name)


def test_where_the_text_does_not_tell_gymnasium_is_asked(monkeypatch):
    monkeypatch.setattr(environment_names, "_ids_in_the_text", lambda: None)
    with pytest.raises(UserError, match="did you mean 'CartPole-v1'"):
        check("CartPol-v1")
    check("CartPole-v1")


@pytest.mark.parametrize("name", ["CartPole-v1", "FrozenLake-v1", "gymnasium:Blackjack-v1"])
def test_a_right_name_passes(name):
    assert check(name) is None
