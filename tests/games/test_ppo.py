"""PPO plays games of two against itself: whose turn it is, what a network sees, and a small game learnt to perfection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import thorndike as td
from games.taking import BEADS, TAKING
from thorndike.algorithms import ppo
from thorndike.api.building import build_algorithm
from thorndike.environments.wrappers import chain, normalize_observation
from thorndike.errors import UserError
from thorndike.games.against import AgainstOpponent
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.packing import packing
from thorndike.games.settings import GameSettings
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.games.turns import game_of_two, turns
from thorndike.networks.masking import without_position
from thorndike.training.sources import compiled_source

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY = jax.random.key(0)


def slow_values() -> dict[int, tuple[float, set[int]]]:
    """Beads -> what the position is worth to the mover, and its best actions, by looking at all there is."""
    found: dict[int, tuple[float, set[int]]] = {}
    for beads in range(1, BEADS + 1):
        worth = {}
        for action in range(min(3, beads)):
            rest = beads - action - 1
            worth[action] = 2.0 if rest == 0 else found[rest][0] * (1 if action == 1 else -1)
        best = max(worth.values())
        found[beads] = best, {action for action, value in worth.items() if value == best}
    return found


SETTINGS = {"n_steps": 16, "batch_size": 128, "n_epochs": 4, "gamma": 1.0, "learning_rate": 3e-3, "ent_coef": 0.03, "net_arch": (32,)}


def test_a_game_in_which_turns_do_not_alternate_is_learnt_to_perfection():
    agent = td.PPO(TAKING, num_envs=32, preset="none", env_kwargs={"opening_share": 0.8, "opening_plies": 4}, **SETTINGS)
    agent.learn(40_000)
    for beads, (worth, best) in slow_values().items():
        position = {"beads": jnp.int32(beads), "player": jnp.int32(1), "mover": jnp.int32(0)}
        obs = jax.tree.map(np.asarray, observed_position(TAKING, position))
        assert int(agent.predict(obs)[0]) in best, beads
        assert abs(float(agent.policy.value(obs)) - worth) < 0.8, beads


def test_turns_are_those_of_the_rules_and_of_the_true_successor():
    environment = game_environment(TAKING, 8, GameSettings(opening_share=0.0))
    algorithm = build_algorithm("ppo", SETTINGS, environment.spec, None)
    source = compiled_source(environment, algorithm, chain())
    noise = jax.tree.map(lambda x: x[0], source.draw(KEY, 1))
    actor = algorithm.actor(jax.jit(algorithm.init)(KEY))
    _, rollout, _ = jax.jit(source.collect)(jax.jit(source.init)(KEY), actor, noise)
    found = np.asarray(turns(TAKING, rollout))
    unpack = jax.jit(jax.vmap(jax.vmap(packing(TAKING).unpack)))
    before, after = (jax.tree.map(np.asarray, unpack(x["position"])) for x in (rollout.obs, rollout.step.next_obs))
    same = before["player"] == after["player"]
    np.testing.assert_array_equal(found, np.where(same, 1.0, -1.0))
    # The true successor, before the next game begins.
    np.testing.assert_array_equal(after["beads"], before["beads"] - np.asarray(rollout.action) - 1)
    np.testing.assert_array_equal(same, (np.asarray(rollout.action) == 1) & (after["beads"] > 0))
    assert same.any() and not same.all() and (after["beads"] == 0).any()
    assert turns(None, rollout) == 1.0


def test_a_network_sees_the_board_and_not_the_position_from_which_to_search():
    spec = game_environment(TIC_TAC_TOE, 4).spec
    assert set(without_position(spec.observation_space).spaces) == {"board", "action_mask"}
    other = spaces.Dict({"position": spaces.Box(-1, 1, (2,)), "action_mask": spaces.MultiBinary(3)})
    assert without_position(other) is other, "an environment that is no game may call anything a position"
    for name in ("ppo", "a2c"):
        algorithm = build_algorithm(name, {}, spec._replace(game=None), None)
        actor = algorithm.actor(jax.jit(algorithm.init)(KEY))
        obs = jax.tree.map(lambda x: x[None], observed_position(TIC_TAC_TOE, TIC_TAC_TOE.init(KEY)))
        other_position = {**obs, "position": obs["position"] + 12345}
        chances = [np.asarray(algorithm.probabilities(actor, (), each)) for each in (obs, other_position)]
        np.testing.assert_array_equal(*chances)
        assert {leaf.shape[0] for leaf in jax.tree.leaves(actor) if leaf.ndim == 2} == {np.prod(TIC_TAC_TOE.observation_shape), 64}


def test_a_wrapper_that_hides_the_position_is_refused_in_one_line():
    spec = game_environment(TIC_TAC_TOE, 4).spec
    with pytest.raises(UserError, match="a wrapper hides"):
        ppo.ppo(ppo.Config(), spec._replace(observation_space=spaces.Box(0, 1, (9,))))
    assert game_of_two(normalize_observation().spec(spec)) is TIC_TAC_TOE
    assert game_of_two(spec._replace(game=TIC_TAC_TOE._replace(num_players=1))) is None


def test_other_learners_are_refused_and_told_who_plays():
    with pytest.raises(UserError, match="train ppo or alphazero or muzero on it"):
        td.train("a2c", "tic_tac_toe", steps=1000)


def test_one_who_plays_alone_is_the_one_evaluated_in_every_game():
    """Of a game of one there is no other seat: an opponent would play it to its end."""
    alone = TAKING._replace(
        num_players=1, player=lambda position: jnp.int32(0), rewards=lambda position: jnp.where(position["beads"] == 0, 3.0, 1.0)[None]
    )
    env = AgainstOpponent(alone, GameSettings(eval_opening_plies=0))
    for seed in range(4):
        env.reset(seed=seed)
        total, over, steps = 0.0, False, 0
        while not over:
            _, reward, over, _, _ = env.step(0)
            total, steps = total + reward, steps + 1
        assert (steps, total) == (BEADS, BEADS - 1 + 3.0)
        env.reset()
