"""The scripts of examples/ do what they say, at a small size."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.utils.env_checker import check_env

import thorndike as td
from thorndike.games.game import named_action
from thorndike.games.search import SearchSettings, search
from thorndike.types import EnvSpec

EXAMPLES = Path(__file__).parents[1] / "examples"


def load(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore:.*alternative render modes.*")
def test_the_courier_is_an_environment_as_gymnasium_wants_it():
    courier = load("own_environment").Courier(size=4, render_mode="rgb_array")
    check_env(courier)
    assert courier.render().shape == (128, 128, 3)


def test_the_courier_delivers_and_the_episode_terminates():
    courier = load("own_environment").Courier(size=5)
    courier.reset(seed=0)
    courier.courier, courier.parcel = np.array([1, 0]), np.array([1, 1])
    obs, reward, terminated, _, _ = courier.step(0)
    assert (obs["carrying"], round(reward, 2), terminated) == (1, 0.48, False)
    courier.step(1)
    _, reward, terminated, truncated, _ = courier.step(3)
    assert (round(reward, 2), terminated, truncated) == (0.98, True, False)


def test_a_network_of_ones_own_gives_logits_and_values():
    spec = EnvSpec("any", Box(-1.0, 1.0, (2, 3)), Discrete(4), num_envs=1)
    network, obs = load("own_network").shared_body(spec, 4), jnp.ones((5, 2, 3))
    with jax.numpy_rank_promotion("allow"):
        logits, values = network.apply(network.init(jax.random.key(0), obs), obs)
    assert (logits.shape, values.shape) == ((5, 4), (5,))


@pytest.mark.slow
def test_a_network_of_ones_own_learns(tmp_path):
    with jax.numpy_rank_promotion("allow"):
        found = load("own_network").main(steps=20_000, seeds=2, output=tmp_path)
    assert found.mean > 60


@pytest.mark.slow
def test_a_hint_leads_to_the_goal(tmp_path):
    plain, shaped = load("reward_shaping").main(output=tmp_path)
    assert shaped.mean > plain.mean


def test_the_hint_is_one_at_the_goal_and_zero_in_the_other_corner():
    nearness = load("reward_shaping").nearness
    assert nearness(np.array([0, 63, 7])).tolist() == [0.0, 1.0, 0.5]


def test_nim_is_a_game_as_people_and_players_see_it():
    nim = load("own_game").NIM
    key = jax.random.key(0)
    step, legal = jax.jit(nim.step), jax.jit(nim.legal)
    random = np.random.default_rng(0)
    for _ in range(20):
        position, moves = nim.init(key), 0
        while not nim.terminated(position):
            board, allowed = nim.board(position), np.flatnonzero(legal(position))
            assert set(board.clicks.values()) == set(allowed.tolist())
            assert sum(square == "O" for row in board.rows for square in row) == nim.observe(position).sum()
            action = int(random.choice(allowed))
            assert named_action(nim, position, nim.action_name(position, action)) == action
            position, moves = step(position, jnp.int32(action), key), moves + 1
        assert moves <= nim.max_moves and nim.rewards(position).tolist() == ([1, -1] if moves % 2 else [-1, 1])


def test_the_search_plays_nim_as_its_theory_says():
    nim = load("own_game").NIM
    key = jax.random.key(0)

    def theory(params, positions, key):
        """Whoever leaves rows whose numbers of beads cancel out bit by bit wins."""
        del params, key
        beads = positions["beads"]
        value = jnp.where(beads[:, 0] ^ beads[:, 1] ^ beads[:, 2] == 0, -1.0, 1.0)
        return jnp.zeros((beads.shape[0], nim.num_actions)), value

    start = nim.init(key)
    settings = SearchSettings("puct", 200)
    found = search(nim, theory, settings, (), jax.tree.map(lambda leaf: leaf[None], start), key, explore=False)
    assert nim.action_name(start, int(found.action[0])) == "a2"


# Games by a name are trained in games/test_own_games.py too, in less time.
@pytest.mark.slow
def test_nim_is_trained_by_its_name(tmp_path, quick_compile):
    name = f"{EXAMPLES / 'own_game.py'}:NIM"
    small = {"n_steps": 2, "batch_size": 16, "gradient_steps": 1, "learning_starts": 32, "num_simulations": 4, "width": 8, "blocks": 0}
    result = td.train("alphazero", name, steps=128, num_envs=16, settings=small, output=tmp_path)
    assert -1 <= td.load(result.run).evaluate(episodes=4).mean <= 1
