"""The policies that come with the library are small, load, and play."""

import jax
import numpy as np
import pytest

import thorndike as td
import tic_tac_toe_lines as lines
from thorndike.games.environment import observed_position
from thorndike.games.registry import game
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.games.trained import trained_run


@pytest.mark.parametrize("id", ["tic_tac_toe", "connect_four"])
def test_there_is_a_small_one_for_the_small_games(id):
    run = trained_run(id)
    assert run is not None
    assert sum(file.stat().st_size for file in run.rglob("*")) < 5_000_000
    loaded = td.load(run)
    assert loaded.facts["environment"] == id
    obs = jax.tree.map(np.asarray, observed_position(game(id), game(id).init(jax.random.key(0))))
    assert abs(float(loaded.value(obs))) <= 1


def test_the_one_of_tic_tac_toe_loses_no_line_even_without_searching():
    policy = td.load(trained_run("tic_tac_toe")).policy
    actor = jax.tree.map(lambda leaf: leaf[policy.best], policy.actors)

    def choose(positions):
        obs = jax.vmap(lambda position: observed_position(TIC_TAC_TOE, position))(positions)
        return policy.algorithm.probabilities(actor, (), obs).argmax(axis=-1)

    walked = [lines.walk(jax.jit(choose), agent) for agent in (0, 1)]
    assert [each.lost for each in walked] == [0, 0]


def test_its_strength_stands_in_its_name_so_that_kept_games_of_another_are_not_taken_for_its_own():
    assert td.player("trained", "tic_tac_toe").name == "trained"
    assert td.player("trained", "tic_tac_toe", simulations=8).name == "trained:simulations=8"


def test_a_player_is_told_by_its_parameters_from_one_that_was_trained_on():
    policy = td.load(trained_run("tic_tac_toe"))
    identity = td.player(policy, "tic_tac_toe").identity
    assert identity == td.player("trained", "tic_tac_toe").identity != ""
    policy.policy.actors = jax.tree.map(lambda leaf: leaf + np.float32(1e-6), policy.policy.actors)
    assert td.player(policy, "tic_tac_toe").identity != identity


@pytest.mark.parametrize("name", ["", "no_such_game", "../tic_tac_toe", "tic_tac_toe/policy"])
def test_there_is_none_of_other_names(name):
    assert trained_run(name) is None
