"""MuZero: its loss, what it refuses, a chain of five states that its model learns by heart, runs that are saved and gone on with."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium import spaces

import thorndike as td
import tic_tac_toe_lines as lines
from thorndike.algorithms.muzero import Config, muzero, muzero_loss
from thorndike.api.building import build_algorithm
from thorndike.errors import UserError
from thorndike.functional.unrolled_targets import UnrolledTargets, unrolled_targets
from thorndike.functional.value_transform import Scale
from thorndike.games.board_view import view_of
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.imagined_search import Imagination
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.networks.learned_model import Judgement, Model, ModelShape, learned_model
from thorndike.replay.unrolled import Unrolled
from thorndike.types import EnvSpec

SMALL = {"num_simulations": 4, "eval_simulations": 2, "learning_starts": 64, "batch_size": 8, "train_freq": 16, "gradient_steps": 1}
SMALL |= {"unroll_steps": 2, "n_step": 3, "net_arch": (8,), "state_size": 6, "width": 8, "atoms": 11, "buffer_size": 400}
VIEW = view_of(EnvSpec("chain", spaces.Box(0.0, 1.0, (5,)), spaces.Discrete(2), 1), 2)


def test_the_loss_is_that_of_a_slow_loop():
    random, steps, count, actions, scale = np.random.default_rng(0), 3, 5, 4, Scale(20.0, 9)
    policy, said_policy = random.dirichlet(np.ones(actions), (steps + 1, count)), random.normal(size=(steps + 1, count, actions))
    value, reward = random.normal(scale=5, size=(steps + 1, count)), random.normal(size=(steps, count))
    said_value, said_reward = random.normal(size=(2, steps + 1, count, 9))
    known, alive = random.random((2, steps + 1, count)) < 0.7
    valid = np.array([1, 1, 0, 1, 1.0])
    by_hand = dict.fromkeys(("policy", "value", "reward"), 0.0)
    of_value, of_reward = (np.asarray(scale.probabilities(jnp.asarray(x, jnp.float32))) for x in (value, reward))
    for m in range(count):
        for k in range(steps + 1):
            weight = valid[m] / valid.sum() * (1.0 if k == 0 else 1.0 / steps)
            for name, target, said, counts in (
                ("policy", policy[k, m], said_policy[k, m], alive[k, m]),
                ("value", of_value[k, m], said_value[k, m], known[k, m]),
                ("reward", of_reward[k - 1, m], said_reward[k, m], known[k, m] and k > 0),
            ):
                logs = said - np.log(np.exp(said).sum())
                by_hand[name] -= weight * counts * (target * logs).sum()

    def judge(params, state):
        del params, state
        return Judgement(*(jnp.asarray(x, jnp.float32) for x in (said_policy, said_value, said_reward)))

    model = Model(None, lambda params, obs: obs, lambda params, state, action: state + 1, judge)
    numbers = (jnp.asarray(x, jnp.float32) for x in (value, reward, known, alive))
    nothing, action = jnp.zeros((steps + 2, count)), jnp.zeros((steps, count), jnp.int32)
    obs, flags = jnp.zeros((count, 2)), jnp.zeros((steps + 2, count), bool)
    taught, valid = jnp.asarray(policy, jnp.float32), jnp.asarray(valid, jnp.float32)
    batch = Unrolled(obs, action, taught, nothing, flags, flags, nothing, obs, (), valid)
    loss, metrics = muzero_loss((), batch, UnrolledTargets(*numbers), Imagination(model, scale, 0.9, VIEW), 0.5)
    for name, expected in by_hand.items():
        assert float(metrics[f"train/{name}_loss"]) == pytest.approx(expected, rel=1e-4), name
    assert float(loss) == pytest.approx(by_hand["policy"] + 0.5 * by_hand["value"] + by_hand["reward"], rel=1e-4)


def test_a_model_learns_a_chain_of_five_states_by_heart():
    """Right and left along five states, a reward of 2 for leaving on the right: what it imagines is worth what will come."""
    gamma, unroll, count, scale = 0.8, 3, 64, Scale(3.0, 21)
    model = learned_model(spaces.Box(0.0, 1.0, (5,)), 2, 21, ModelShape((16,), "nature", 12, 24))
    imagination, random = Imagination(model, scale, gamma, VIEW), np.random.default_rng(0)
    place, actions = random.integers(0, 5, count), random.integers(0, 2, (unroll + 1, count))
    worth = np.append(2 * gamma ** np.arange(4, -1, -1), 0.0)
    places = [place]
    for step in actions:
        places.append(np.where(places[-1] == 5, 5, np.maximum(places[-1] + np.where(step == 1, 1, -1), 0)))
    there = np.stack(places)
    reward, done = 2.0 * (there[1:] == 5) * (there[:-1] < 5), there[1:] == 5
    targets = unrolled_targets(*map(jnp.asarray, (reward.astype(np.float32), worth[there[1:]].astype(np.float32), done, done)), gamma, 1)
    exact = targets._replace(value=jnp.asarray(np.where(there[:-1] == 5, 0.0, worth[there[:-1]]), jnp.float32))
    best = jnp.tile(jnp.array([0.0, 1.0]), (unroll + 1, count, 1))
    obs, nothing, flags = jax.nn.one_hot(jnp.asarray(place), 5), jnp.zeros((unroll + 1, count)), jnp.zeros((unroll + 1, count), bool)
    batch = Unrolled(obs, jnp.asarray(actions[:unroll], jnp.int32), best, nothing, flags, flags, nothing, obs, (), jnp.ones(count))
    params, optimizer = model.network.init(jax.random.key(0), obs), optax.adam(optax.linear_schedule(5e-3, 1e-4, 600))

    def step(carry, _):
        params, state = carry
        updates, state = optimizer.update(jax.grad(lambda p: muzero_loss(p, batch, exact, imagination, 1.0)[0])(params), state)
        return (optax.apply_updates(params, updates), state), None

    (params, _), _ = jax.jit(lambda carry: jax.lax.scan(step, carry, None, length=600))((params, optimizer.init(params)))
    state = model.represent(params, obs)
    for k in range(unroll + 1):
        said = model.judge(params, state)
        np.testing.assert_allclose(scale.number(said.value), exact.value[k], atol=0.1)
        if k:
            np.testing.assert_allclose(scale.number(said.reward), exact.reward[k - 1], atol=0.1)
        if k < unroll:
            state = model.follow(params, state, batch.action[k])


def test_what_it_cannot_learn_is_refused():
    with pytest.raises(UserError, match=r"muzero takes Discrete actions; Pendulum-v1 has Box.*ppo, sac"):
        build_algorithm("muzero", {}, td.make("Pendulum-v1", 2).spec, None)
    spec = game_environment(TIC_TAC_TOE, 2).spec
    with pytest.raises(UserError, match=r"two players without dice.*train it with ppo"):
        muzero(Config(), spec._replace(game=TIC_TAC_TOE._replace(has_chance=True)))
    with pytest.raises(UserError, match="buffer_size 10 holds fewer than the"):
        build_algorithm("muzero", {"buffer_size": 10, "train_freq": 2}, spec, None)


@pytest.mark.parametrize(
    ("environment", "engine"), [pytest.param("tic_tac_toe", "auto", marks=pytest.mark.slow), ("CartPole-v1", "gymnasium")]
)
def test_a_run_is_saved_loaded_and_gone_on_with(environment: str, engine: str, tmp_path: Path, quick_compile: None):
    result = td.train("muzero", environment, steps=256, num_envs=8, engine=engine, settings=SMALL, preset="none", output=tmp_path)
    policy = td.load(result.run)
    evaluation = policy.evaluate(episodes=4)
    assert np.isfinite(evaluation.mean) and len(evaluation.rows) == 4
    assert td.resume(result.run, steps=320).steps == 320
    obs = np.zeros(4, np.float32)
    if environment == "tic_tac_toe":
        obs = jax.tree.map(np.asarray, observed_position(TIC_TAC_TOE, TIC_TAC_TOE.init(jax.random.key(0))))
    action, _ = policy.predict(obs)
    assert policy.policy.spec.action_space.contains(int(action)) and np.isfinite(policy.value(obs))


@pytest.mark.slow
def test_hardly_a_line_of_tic_tac_toe_is_lost_by_who_was_never_told_the_rules(tmp_path: Path, capsys: pytest.CaptureFixture):
    result = td.train("muzero", "tic_tac_toe", output=tmp_path)
    for simulations in (0, 64):
        choose = lines.chooser(result.run, simulations)
        walked = [lines.walk(choose, agent) for agent in (0, 1)]
        with capsys.disabled():
            print(f"\n{result.cpu_s:.0f} CPU-s; {simulations} simulations: first {walked[0]}, second {walked[1]}")
        assert walked[0].lost + walked[1].lost <= 30
