import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, Tuple

from thorndike.algorithms.planning import policy_evaluation
from thorndike.algorithms.q_learning import Config, Extras, q_learning
from thorndike.environments.native.table import read_table, table_dynamics
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.wrappers import chain
from thorndike.errors import UserError
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import EnvSpec, Rollout, Step

STATES, ACTIONS, ENVS, STEPS = 3, 2, 2, 5
GAMMA, RATE, EPSILON, LAMBDA = 0.9, 0.5, 0.2, 0.8
SPEC = EnvSpec("test", Discrete(STATES), Discrete(ACTIONS), ENVS)


def settings(variant, **more):
    constant = {"exploration_initial_eps": EPSILON, "exploration_final_eps": EPSILON, "gamma": GAMMA, "learning_rate": RATE}
    return Config(**{"total_steps": 1000, "variant": variant, "n_steps": STEPS, "trace_decay": LAMBDA, **constant, **more})


def random_rollout(seed, double=False):
    """Few states and many steps, so that rows of a batch meet in the same state and action."""
    rng = np.random.default_rng(seed)
    shape = (STEPS, ENVS)
    terminated, truncated = rng.random(shape) < 0.2, rng.random(shape) < 0.2
    states = [rng.integers(0, STATES, shape).astype(np.int32) for _ in range(3)]
    flags = Extras(greedy=rng.random(shape) < 0.7, coin=double & (rng.random(shape) < 0.5))
    reward = rng.normal(size=shape).astype(np.float32)
    step = Step(states[1], states[2], reward, np.zeros_like(reward), terminated, truncated, rng.random(shape) < 0.9)
    rollout = Rollout(states[0], rng.integers(0, ACTIONS, shape).astype(np.int32), flags, step, ())
    return jax.tree.map(jnp.asarray, rollout)


def flat_rows(rollout):
    """Dicts in the order of time, then of environments."""
    step, rows = rollout.step, []
    for t in range(rollout.action.shape[0]):
        for env in range(ENVS):
            columns = {"s": rollout.obs, "a": rollout.action, "r": step.reward, "s2": step.next_obs, "end": step.terminated}
            columns |= {"cut": step.truncated, "valid": step.valid, "greedy": rollout.extras.greedy, "coin": rollout.extras.coin}
            rows.append({"env": env, **{name: np.asarray(column)[t, env].item() for name, column in columns.items()}})
    return rows


def expectation(row):
    return (1 - EPSILON) * row.max() + EPSILON * row.mean()


def slow_q_learning(rollouts):
    q = np.zeros((STATES, ACTIONS))
    for row in (row for rollout in rollouts for row in flat_rows(rollout) if row["valid"]):
        q[row["s"], row["a"]] += RATE * (row["r"] + GAMMA * (not row["end"]) * q[row["s2"]].max() - q[row["s"], row["a"]])
    return q


def slow_expected_sarsa(rollouts):
    q = np.zeros((STATES, ACTIONS))
    for row in (row for rollout in rollouts for row in flat_rows(rollout) if row["valid"]):
        q[row["s"], row["a"]] += RATE * (row["r"] + GAMMA * (not row["end"]) * expectation(q[row["s2"]]) - q[row["s"], row["a"]])
    return q


def slow_double_q(rollouts):
    q = np.zeros((2, STATES, ACTIONS))
    for row in (row for rollout in rollouts for row in flat_rows(rollout) if row["valid"]):
        own, other = q[int(row["coin"])], q[1 - int(row["coin"])]
        future = other[row["s2"], own[row["s2"]].argmax()]
        own[row["s"], row["a"]] += RATE * (row["r"] + GAMMA * (not row["end"]) * future - own[row["s"], row["a"]])
    return np.concatenate(q, axis=1)


def slow_sarsa(rollouts):
    q, waiting = np.zeros((STATES, ACTIONS)), [None] * ENVS
    for row in (row for rollout in rollouts for row in flat_rows(rollout)):
        old, waiting[row["env"]] = waiting[row["env"]], row
        if old is None or not old["valid"]:
            continue
        future = expectation(q[old["s2"]]) if old["cut"] else q[old["s2"], row["a"]]
        q[old["s"], old["a"]] += RATE * (old["r"] + GAMMA * (not old["end"]) * future - q[old["s"], old["a"]])
    return q


def slow_q_lambda(rollouts):
    q, traces = np.zeros((STATES, ACTIONS)), np.zeros((ENVS, STATES, ACTIONS))
    for row in (row for rollout in rollouts for row in flat_rows(rollout)):
        trace = traces[row["env"]]
        if row["valid"]:
            trace *= GAMMA * LAMBDA if row["greedy"] else 0.0
            trace[row["s"], row["a"]] = 1.0
            q += RATE * (row["r"] + GAMMA * (not row["end"]) * q[row["s2"]].max() - q[row["s"], row["a"]]) * trace
        if row["end"] or row["cut"] or not row["valid"]:
            trace[:] = 0.0
    return q


SLOW = {
    "q_learning": slow_q_learning,
    "sarsa": slow_sarsa,
    "expected_sarsa": slow_expected_sarsa,
    "double_q": slow_double_q,
    "q_lambda": slow_q_lambda,
}


@pytest.mark.parametrize("variant", SLOW)
def test_updates_equal_a_slow_loop_for_one_seed_and_for_many(variant):
    algorithm = q_learning(settings(variant), SPEC)
    rollouts = [[random_rollout(100 * seed + k, double=variant == "double_q") for k in range(3)] for seed in range(2)]
    key = jax.random.key(0)
    alone, many = jax.jit(algorithm.update), jax.jit(jax.vmap(algorithm.update, in_axes=(0, 0, None)))
    states = jax.vmap(algorithm.init)(jax.random.split(key, 2))
    for first, second in zip(*rollouts, strict=True):
        states, _ = many(states, jax.tree.map(lambda *x: jnp.stack(x), first, second), key)
    single = algorithm.init(key)
    for rollout in rollouts[1]:
        single, _ = alone(single, rollout, key)
    for seed in range(2):
        np.testing.assert_allclose(states.tables.q[seed], SLOW[variant](rollouts[seed]), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(states.tables.q[1], single.tables.q)


def test_environments_that_meet_in_a_pair_count_as_successive_steps():
    algorithm = q_learning(settings("q_learning", n_steps=1), SPEC)
    same, ones = jnp.zeros((1, ENVS), jnp.int32), jnp.ones((1, ENVS))
    yes, no = jnp.ones((1, ENVS), bool), jnp.zeros((1, ENVS), bool)
    rollout = Rollout(same, same, Extras(yes, no), Step(same, same, ones, 0 * ones, yes, no, yes), ())
    state, _ = jax.jit(algorithm.update)(algorithm.init(jax.random.key(0)), rollout, jax.random.key(1))
    assert float(state.tables.q[0, 0]) == pytest.approx(1 - (1 - RATE) ** ENVS)


def test_the_step_size_falls_with_the_visits_of_each_pair():
    algorithm = q_learning(settings("q_learning", n_steps=4, learning_rate=1.0, visits_power=1.0), SPEC._replace(num_envs=1))

    def column(values, kind):
        return jnp.array(values, kind)[:, None]

    zeros, yes, no = column([0] * 4, jnp.int32), column([True] * 4, bool), column([False] * 4, bool)
    valid = column([False, True, True, True], bool)
    rewards = column([50.0, 1.0, 2.0, 6.0], jnp.float32)
    rollout = Rollout(zeros, zeros, Extras(yes, no), Step(zeros, zeros, rewards, 0 * rewards, yes, no, valid), ())
    state, metrics = jax.jit(algorithm.update)(algorithm.init(jax.random.key(0)), rollout, jax.random.key(1))
    assert float(state.tables.q[0, 0]) == pytest.approx(3.0)
    assert int(state.tables.visits[0, 0]) == 3
    assert np.isfinite(float(metrics["train/td_error"]))


def test_epsilon_falls_by_episodes_to_its_floor():
    decay = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.01, "exploration_decay": 0.5}
    algorithm = q_learning(settings("q_learning", **decay), SPEC)
    rollout = random_rollout(0)
    ended = int((rollout.step.done & rollout.step.valid).sum())
    state = algorithm.init(jax.random.key(0))
    assert float(algorithm.actor(state).epsilon) == 1.0
    update = jax.jit(algorithm.update)
    state, _ = update(state, rollout, jax.random.key(0))
    assert ended > 0
    assert float(algorithm.actor(state).epsilon) == pytest.approx(0.5**ended)
    for _ in range(20):
        state, _ = update(state, rollout, jax.random.key(0))
    assert float(algorithm.actor(state).epsilon) == pytest.approx(0.01)


def test_epsilon_falls_linearly_over_its_part_of_the_run():
    linear = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.1, "exploration_fraction": 0.5}
    algorithm = q_learning(settings("q_learning", total_steps=STEPS * ENVS * 4, **linear), SPEC)
    state, update, seen = algorithm.init(jax.random.key(0)), jax.jit(algorithm.update), []
    for _ in range(5):
        seen.append(float(algorithm.actor(state).epsilon))
        state, _ = update(state, random_rollout(0), jax.random.key(0))
    np.testing.assert_allclose(seen, [1.0, 0.55, 0.1, 0.1, 0.1], rtol=1e-6)


def test_upper_confidence_tries_every_action_of_a_state_before_any_again():
    algorithm = q_learning(settings("q_learning", exploration="ucb", ucb_coefficient=0.5), SPEC)
    state, obs = algorithm.init(jax.random.key(0)), jnp.array([0, 2])
    noise = jax.tree.map(lambda leaf: leaf[0], algorithm.draw(jax.random.key(1), 1))
    rollout = random_rollout(0)
    tried = rollout._replace(obs=jnp.zeros_like(rollout.obs), action=jnp.ones_like(rollout.action))
    state, metrics = algorithm.update(state, tried, jax.random.key(2))
    actor = algorithm.actor(state)
    np.testing.assert_array_equal(actor.visits, [[0, int(rollout.step.valid.sum())], [0, 0], [0, 0]])
    assert metrics["rollout/exploration_rate"] == 0
    assert algorithm.act(actor, (), obs, noise)[1][0] == 0, "whatever the other one is worth"
    untried = actor._replace(q=actor.q.at[0].set(jnp.array([5.0, 0.0])), visits=jnp.array([[90, 2], [0, 0], [0, 0]]))
    expected = 5.0 + 0.5 * np.sqrt(np.log(92) / 90) < 0.5 * np.sqrt(np.log(92) / 2)
    assert algorithm.act(untried, (), obs, noise)[1][0] == int(expected)


def test_boltzmann_exploration_follows_its_temperature_and_on_policy_targets_refuse_it():
    algorithm = q_learning(settings("q_lambda", exploration="boltzmann", temperature="linear(2, 1)"), SPEC)
    state = algorithm.init(jax.random.key(0))
    assert algorithm.actor(state).epsilon == 2.0
    state, metrics = algorithm.update(state, random_rollout(0), jax.random.key(2))
    assert metrics["rollout/exploration_rate"] == 2.0
    assert 1.9 < algorithm.actor(state).epsilon < 2.0
    for variant in ("sarsa", "expected_sarsa"):
        with pytest.raises(UserError, match="set exploration to epsilon"):
            settings(variant, exploration="ucb")


def test_the_greedy_policy_takes_the_best_action_and_the_value_is_its_own():
    space = Tuple((Discrete(2), Discrete(2)))
    algorithm = q_learning(settings("q_learning"), SPEC._replace(observation_space=space, action_space=Discrete(2, start=3)))
    # Learners count actions from 0; the engine adds the space's start.
    actor = algorithm.actor(algorithm.init(jax.random.key(0)))._replace(q=jnp.array([[0.0, 1], [2, 0], [3, 0], [0, 4]]))
    obs = (jnp.array([0, 1], jnp.int32), jnp.array([1, 1], jnp.int32))
    noise = jax.tree.map(lambda x: x[0], algorithm.draw(jax.random.key(0), 1))
    np.testing.assert_array_equal(algorithm.greedy(actor, (), obs, noise)[1], [0, 1])
    np.testing.assert_array_equal(algorithm.value(actor, obs), [2.0, 4.0])


def test_a_batched_action_space_is_refused():
    with pytest.raises(UserError, match="Discrete actions"):
        q_learning(settings("q_learning"), SPEC._replace(action_space=Box(-1.0, 1.0, (1,))))


def test_a_table_too_large_is_refused():
    with pytest.raises(UserError, match="fewer bins"):
        q_learning(settings("q_learning"), SPEC._replace(observation_space=Discrete(2**30)))


def test_it_learns_the_shortest_way_along_the_cliff():
    table = read_table(gymnasium.make("CliffWalking-v1"))
    environment = vectorize(table_dynamics(table), 1)
    algorithm = q_learning(Config(total_steps=60_000, learning_rate=0.5, gamma=0.99), environment.spec)
    agents = runner(algorithm, compiled_source(environment, algorithm, chain()), 0, range(3))
    carry, _ = agents.advance(agents.init(), 0, 60_000)
    for q in np.asarray(carry.learner.tables.q):
        assert table.initial @ policy_evaluation(table, q.argmax(axis=1), 1.0, steps=100) == -13.0
