import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.wrappers import (
    centre_reward,
    chain,
    discretise,
    exported,
    frame_stack,
    from_settings,
    normalize_observation,
    normalize_reward,
    potential_shaping,
    select_observation,
    shape_reward,
    wrap,
)
from thorndike.errors import UserError
from thorndike.types import EnvSpec, Rollout, Step

BOX = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, 10.0], np.float32))


def make_spec(space: gymnasium.Space, num_envs: int = 2) -> EnvSpec:
    return EnvSpec("test", space, spaces.Discrete(2), num_envs)


def make_step(obs, next_obs=None, reward=0.0, terminated=False, truncated=False, valid=True) -> Step:
    batch = jax.tree.leaves(obs)[0].shape[0]
    flags = [np.broadcast_to(np.asarray(flag, bool), batch) for flag in (terminated, truncated, valid)]
    reward = np.broadcast_to(np.asarray(reward), batch)
    return Step(obs, obs if next_obs is None else next_obs, reward, np.zeros(batch, np.float32), *flags)


def act_through(wrapper, statistics, observations, valid, reward=None):
    """Feed a stream of observations [T + 1, B, ...] through a wrapper: its memory and the rollout it makes."""
    memory, shown = wrapper.init(statistics, observations[0])
    step_of = jax.jit(wrapper.step)
    rows = []
    for t, mask in enumerate(valid):
        own = np.zeros(len(mask), np.float32) if reward is None else reward[t]
        action = np.zeros(len(mask), np.int32)
        memory, step = step_of(statistics, memory, observations[t], action, make_step(observations[t + 1], reward=own, valid=mask))
        rows.append((shown, action, (), step))
        shown = step.obs
    obs, action, extras, step = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
    return memory, Rollout(obs, action, extras, step, ())


# discretise


def test_discretise_numbers_bins_row_major_and_clamps_what_lies_outside():
    wrapper = discretise([4, 5])
    assert wrapper.spec(make_spec(BOX)).observation_space == spaces.Discrete(20)
    rng = np.random.default_rng(0)
    obs = rng.uniform([-1.5, -2.0], [1.5, 12.0], (500, 2)).astype(np.float32)
    _, shown = wrapper.init(wrapper.statistics(make_spec(BOX)), obs)
    edges = np.linspace(-1, 1, 5)[1:-1], np.linspace(0, 10, 6)[1:-1]
    expected = np.digitize(obs[:, 0], edges[0]) * 5 + np.digitize(obs[:, 1], edges[1])
    np.testing.assert_array_equal(shown, expected)
    assert set(expected) == set(range(20))


def test_discretise_shows_both_the_next_input_and_the_true_successor():
    wrapper = discretise(2)
    statistics = wrapper.statistics(make_spec(BOX))
    low, high = np.array([[-1.0, 0.0]], np.float32), np.array([[0.9, 9.0]], np.float32)
    memory, _ = wrapper.init(statistics, low)
    _, step = wrapper.step(statistics, memory, low, np.zeros(1, np.int32), make_step(low, high, terminated=True))
    assert (int(step.obs[0]), int(step.next_obs[0])) == (0, 3)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"bins": 10}, "finite low for dimensions [1, 3]"),
        ({"bins": [1, 2]}, "one for each of the 4 dimensions"),
        ({"bins": 0}, "at least 1"),
        ({"bins": 1000, "low": -1, "high": 1}, "fewer bins"),
        ({"bins": 2, "low": 1, "high": 0}, "low < high"),
        ({"bins": 2, "low": [1.0]}, "4 values of low"),
    ],
)
def test_discretise_names_what_is_wrong(settings, words):
    space = gymnasium.make("CartPole-v1").observation_space
    with pytest.raises(UserError, match=words.replace("[", r"\[").replace("]", r"\]")):
        discretise(**settings).spec(make_spec(space))


def test_discretise_takes_the_missing_bounds_from_the_space():
    space = gymnasium.make("CartPole-v1").observation_space
    wrapper = discretise(10, low=[None, -3.0, None, -4.0], high=[None, 3.0, None, 4.0])
    statistics = wrapper.statistics(make_spec(space))
    np.testing.assert_allclose(statistics.low, [-4.8, -3.0, -0.41887903, -4.0], rtol=1e-6)
    assert wrapper.spec(make_spec(space)).observation_space.n == 10_000


def test_discretise_refuses_whole_numbers():
    with pytest.raises(UserError, match="Box"):
        discretise(3).spec(make_spec(spaces.Discrete(4)))


# reward shaping


def random_mdp(seed: int, states: int = 6, actions: int = 3):
    """Transition probabilities [S, A, S], rewards [S, A, S], which arrivals terminate [S, A, S]."""
    rng = np.random.default_rng(seed)
    return (
        rng.dirichlet(np.ones(states), (states, actions)),
        rng.normal(size=(states, actions, states)),
        rng.random((states, actions, states)) < 0.2,
    )


def optimal_q(probability: np.ndarray, reward: np.ndarray, terminated: np.ndarray, gamma: float) -> np.ndarray:
    q = np.zeros(probability.shape[:2])
    for _ in range(400):
        q = np.sum(probability * (reward + gamma * np.where(terminated, 0.0, q.max(-1))), -1)
    return q


def shaped_rewards(wrapper, reward: np.ndarray, terminated: np.ndarray) -> np.ndarray:
    """What the wrapper makes of every transition (s, a, s') of an MDP, in one batch."""
    state, action, after = np.indices(reward.shape).reshape(3, -1)
    step = make_step(after, after, reward.ravel(), terminated.ravel())
    _, shaped = wrapper.step((), (), state, action, step)
    return np.asarray(shaped.reward).reshape(reward.shape)


def test_potential_shaping_changes_every_optimal_value_by_the_potential_alone():
    gamma, worst = 0.9, 0.0
    with jax.enable_x64(True):
        for seed in range(100):
            probability, reward, terminated = random_mdp(seed)
            phi = np.random.default_rng(seed + 1000).normal(size=6)
            wrapper = potential_shaping(lambda obs, phi=phi: jnp.asarray(phi)[obs], gamma)
            shaped = shaped_rewards(wrapper, reward, terminated)
            difference = optimal_q(probability, shaped, terminated, gamma) - (
                optimal_q(probability, reward, terminated, gamma) - phi[:, None]
            )
            worst = max(worst, np.abs(difference).max())
    assert worst < 1e-8


def test_shaping_without_gamma_breaks_the_invariance():
    gamma, changed = 0.9, 0
    for seed in range(20):
        probability, reward, terminated = random_mdp(seed)
        phi = np.random.default_rng(seed + 1000).normal(size=6)
        shaped = shaped_rewards(potential_shaping(lambda obs, phi=phi: jnp.asarray(phi)[obs], 1.0), reward, terminated)
        before, after = optimal_q(probability, reward, terminated, gamma), optimal_q(probability, shaped, terminated, gamma)
        assert np.abs(after - (before - phi[:, None])).max() > 1e-2
        changed += int(np.any(before.argmax(-1) != after.argmax(-1)))
    assert changed > 0


def test_the_potential_is_zero_after_a_termination_but_not_at_a_time_limit_nor_on_a_dead_row():
    wrapper = potential_shaping(lambda obs: obs[:, 0], 0.5)
    obs, next_obs = np.full((4, 1), 3.0, np.float32), np.full((4, 1), 8.0, np.float32)
    step = make_step(obs, next_obs, 1.0, terminated=[0, 1, 0, 0], truncated=[0, 0, 1, 0], valid=[1, 1, 1, 0])
    _, shaped = wrapper.step((), (), obs, np.zeros(4, np.int32), step)
    np.testing.assert_allclose(shaped.reward, [1 + 4 - 3, 1 + 0 - 3, 1 + 4 - 3, 1])


def test_shape_reward_sees_the_observation_acted_on_the_action_and_the_step():
    wrapper = shape_reward(lambda obs, action, step: obs[:, 0] + 10 * action + 100 * step.next_obs[:, 0] + step.reward)
    obs, next_obs = np.array([[1.0], [2.0], [5.0]], np.float32), np.array([[3.0], [4.0], [6.0]], np.float32)
    step = make_step(obs, next_obs, 0.5, valid=[True, True, False])
    _, shaped = wrapper.step((), (), obs, np.array([0, 1, 1]), step)
    np.testing.assert_allclose(shaped.reward, [301.5, 412.5, 0.0])


# normalisation


def test_observation_statistics_are_those_of_the_valid_rows_acted_on():
    wrapper = normalize_observation()
    spec = make_spec(spaces.Box(-np.inf, np.inf, (3,)), 4)
    rng = np.random.default_rng(0)
    statistics, seen = wrapper.statistics(spec), []
    for _ in range(3):
        observations = rng.normal(1e4, 2, (21, 4, 3)).astype(np.float32)
        valid = rng.random((20, 4)) < 0.8
        memory, rollout = act_through(wrapper, statistics, observations, valid)
        seen.append(observations[:-1][valid])
        statistics, memory, same = wrapper.learn(statistics, memory, rollout)
        assert same is rollout
    rows = np.concatenate(seen).astype(np.float64)
    assert float(statistics[0].seen) == len(rows)
    np.testing.assert_allclose(statistics[0].mean, rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(statistics[0].variance, rows.var(0), rtol=5e-2)
    assert float(memory[0].seen.sum()) == 0
    _, shown = wrapper.init(statistics, rows[:50].astype(np.float32))
    assert abs(float(shown.mean())) < 0.3 and 0.7 < float(shown.std()) < 1.3


def test_statistics_are_frozen_while_acting():
    wrapper = normalize_observation(clip=5.0)
    statistics = wrapper.statistics(make_spec(spaces.Box(-np.inf, np.inf, (1,))))
    observations = np.full((4, 2, 1), 3.0, np.float32)
    observations[-1] = 1e3
    _, rollout = act_through(wrapper, statistics, observations, np.ones((3, 2), bool))
    np.testing.assert_allclose(rollout.obs, 3.0, rtol=1e-6)
    np.testing.assert_allclose(rollout.step.next_obs[-1], 5.0)


def test_only_float_leaves_of_a_dict_are_normalised():
    space = spaces.Dict({"z": spaces.Box(-5, 5, (2,)), "image": spaces.Box(0, 255, (2, 2, 1), np.uint8), "a": spaces.Discrete(3)})
    wrapper = normalize_observation()
    statistics = wrapper.statistics(make_spec(space, 2))
    obs = {"z": np.full((2, 2), 2.0, np.float32), "image": np.full((2, 2, 2, 1), 200, np.uint8), "a": np.array([1, 2], np.int32)}
    memory, shown = wrapper.init(statistics, obs)
    memory, step = wrapper.step(statistics, memory, obs, np.zeros(2, np.int32), make_step(obs))
    statistics, memory, _ = wrapper.learn(statistics, memory, Rollout(obs, None, (), step, ()))
    _, shown = wrapper.init(statistics, obs)
    np.testing.assert_allclose(shown["z"], 0.0, atol=1e-6)
    np.testing.assert_array_equal(shown["image"], obs["image"])
    np.testing.assert_array_equal(shown["a"], obs["a"])
    shown_space = wrapper.spec(make_spec(space)).observation_space
    assert shown_space["image"] == space["image"] and shown_space["z"].high.max() == 10


def test_rewards_are_divided_by_the_deviation_of_the_discounted_return():
    gamma, rng = 0.9, np.random.default_rng(1)
    wrapper = normalize_reward(gamma, clip=1e9)
    statistics, memory = wrapper.statistics(make_spec(BOX, 3)), np.zeros(3, np.float32)
    returns, current = [], np.zeros(3)
    for _ in range(2):
        reward, done, valid = rng.normal(5, 100, (30, 3)).astype(np.float32), rng.random((30, 3)) < 0.1, rng.random((30, 3)) < 0.9
        done &= valid
        for t in range(30):
            current = gamma * current + np.where(valid[t], reward[t], 0)
            returns.extend(current[valid[t]])
            current = np.where(done[t], 0, current)
        zeros = np.zeros((30, 3, 1), np.float32)
        step = Step(zeros, zeros, reward, reward, done, np.zeros_like(done), valid)
        statistics, memory, rollout = wrapper.learn(statistics, memory, Rollout(zeros, None, (), step, ()))
        np.testing.assert_allclose(rollout.step.reward, reward / np.std(returns), rtol=1e-4)
    np.testing.assert_allclose(memory, current, rtol=1e-4, atol=1e-3)


# frame stack


def test_a_stack_keeps_the_old_frames_at_an_end_and_starts_afresh_after_it():
    wrapper = frame_stack(3)
    first, second, end, fresh = (np.full((1, 2), value, np.float32) for value in (1, 2, 3, 9))
    memory, shown = wrapper.init((), first)
    np.testing.assert_array_equal(shown, [[1, 1, 1, 1, 1, 1]])
    action = np.zeros(1, np.int32)
    memory, step = wrapper.step((), memory, first, action, make_step(second))
    np.testing.assert_array_equal(step.obs, [[1, 1, 1, 1, 2, 2]])
    memory, step = wrapper.step((), memory, second, action, make_step(fresh, end, truncated=True))
    np.testing.assert_array_equal(step.next_obs, [[1, 1, 2, 2, 3, 3]])
    np.testing.assert_array_equal(step.obs, [[9, 9, 9, 9, 9, 9]])
    memory, step = wrapper.step((), memory, fresh, action, make_step(first))
    np.testing.assert_array_equal(step.obs, [[9, 9, 9, 9, 1, 1]])


def test_a_stack_starts_afresh_after_a_dead_row():
    wrapper = frame_stack(2)
    first, end, fresh = (np.full((1, 1), value, np.float32) for value in (1, 3, 9))
    memory, _ = wrapper.init((), first)
    action = np.zeros(1, np.int32)
    memory, step = wrapper.step((), memory, first, action, make_step(end, terminated=True))
    np.testing.assert_array_equal(step.next_obs, [[1, 3]])
    memory, step = wrapper.step((), memory, end, action, make_step(fresh, valid=False))
    np.testing.assert_array_equal(step.obs, [[9, 9]])


@pytest.mark.parametrize(
    ("space", "shape"),
    [
        (spaces.Box(0, 255, (8, 8, 3), np.uint8), (8, 8, 12)),
        (spaces.Box(-1, 1, (5,)), (20,)),
        (spaces.Box(-1, 1, ()), (4,)),
        (spaces.Discrete(7), (4,)),
        (spaces.MultiBinary(3), (12,)),
    ],
)
def test_every_leaf_is_stacked_on_its_last_axis_and_the_space_agrees(space, shape):
    both = spaces.Dict({"leaf": space, "other": BOX})
    wrapper = frame_stack(4)
    shown_space = wrapper.spec(make_spec(both)).observation_space
    obs = {"leaf": np.stack([space.sample(), space.sample()]), "other": np.stack([BOX.sample(), BOX.sample()])}
    _, shown = wrapper.init((), obs)
    assert shown_space["leaf"].shape == shape == shown["leaf"].shape[1:]
    assert shown_space["leaf"].contains(np.asarray(shown["leaf"][0], shown_space["leaf"].dtype))
    assert shown["leaf"].dtype == obs["leaf"].dtype or space.dtype == np.int64


def test_only_the_selected_entries_are_shown_in_their_order():
    wrapper = select_observation([1, 0])
    space = wrapper.spec(make_spec(BOX)).observation_space
    np.testing.assert_array_equal(space.high, [10, 1])
    first, end = np.array([[0.5, 3.0]], np.float32), np.array([[-0.5, 4.0]], np.float32)
    memory, shown = wrapper.init((), first)
    np.testing.assert_array_equal(shown, [[3.0, 0.5]])
    _, step = wrapper.step((), memory, first, np.zeros(1, np.int32), make_step(first, end, truncated=True))
    np.testing.assert_array_equal(step.obs, [[3.0, 0.5]])
    np.testing.assert_array_equal(step.next_obs, [[4.0, -0.5]])


@pytest.mark.parametrize(
    ("space", "entries", "words"),
    [(BOX, [0, 2], "no entry 2; .* 0 to 1"), (BOX, [], "no entry was named"), (spaces.Discrete(3), [0], "a Box vector, not of Discrete")],
)
def test_entries_that_are_not_there_cannot_be_selected(space, entries, words):
    with pytest.raises(UserError, match=words):
        select_observation(entries).spec(make_spec(space))


# composition


def test_a_chain_gives_each_wrapper_the_observation_it_showed():
    seen = []

    def record(obs, action, step):
        seen.append(np.asarray(obs))
        return step.reward

    wrapper = chain(shape_reward(record), frame_stack(2), shape_reward(record))
    memory, shown = wrapper.init(((), (), ()), np.ones((1, 1), np.float32))
    action = np.zeros(1, np.int32)
    for value in (2, 3):
        own = np.full((1, 1), value - 1, np.float32)
        memory, step = wrapper.step(((), (), ()), memory, own, action, make_step(np.full((1, 1), value, np.float32)))
        assert seen[-2].tolist() == own.tolist()
        assert seen[-1].tolist() == np.asarray(shown).tolist()
        shown = step.obs


def test_normalise_then_stack_normalises_single_frames():
    wrapper = chain(normalize_observation(), frame_stack(2))
    spec = make_spec(spaces.Box(-np.inf, np.inf, (3,)), 4)
    statistics = wrapper.statistics(spec)
    assert statistics[0][0].mean.shape == (3,)
    assert wrapper.spec(spec).observation_space.shape == (6,)
    observations = np.random.default_rng(0).normal(7, 1, (11, 4, 3)).astype(np.float32)
    memory, rollout = act_through(wrapper, statistics, observations, np.ones((10, 4), bool))
    statistics, memory, _ = wrapper.learn(statistics, memory, rollout)
    np.testing.assert_allclose(statistics[0][0].mean, observations[:-1].mean((0, 1)), rtol=1e-5)
    assert rollout.obs.shape == (10, 4, 6)


def test_an_exported_chain_is_rebuilt_and_shows_the_same():
    wrapper = chain(
        normalize_reward(0.9), normalize_observation(clip=3.0), shape_reward(lambda obs, action, step: step.reward), frame_stack(2)
    )
    spec = make_spec(spaces.Box(-np.inf, np.inf, (3,)), 4)
    observations = np.random.default_rng(0).normal(7, 1, (11, 4, 3)).astype(np.float32)
    statistics = wrapper.statistics(spec)
    memory, rollout = act_through(wrapper, statistics, observations, np.ones((10, 4), bool))
    statistics, memory, _ = wrapper.learn(statistics, memory, rollout)
    part = exported(wrapper, statistics)
    assert [settings["name"] for settings in part.settings] == ["normalize_reward", "normalize_observation", "frame_stack"]
    rebuilt = from_settings(part.settings)
    assert jax.tree.structure(rebuilt.statistics(spec)) == jax.tree.structure(part.statistics)
    memory, shown = wrapper.init(statistics, observations[0])
    rebuilt_memory, rebuilt_shown = rebuilt.init(part.statistics, observations[0])
    np.testing.assert_array_equal(shown, rebuilt_shown)
    action, step = np.zeros(4, np.int32), make_step(observations[1])
    _, after = wrapper.step(statistics, memory, observations[0], action, step)
    _, rebuilt_after = rebuilt.step(part.statistics, rebuilt_memory, observations[0], action, step)
    np.testing.assert_array_equal(after.obs, rebuilt_after.obs)


def test_settings_of_an_unknown_wrapper_are_refused_by_name():
    with pytest.raises(UserError, match="did you mean 'frame_stack'"):
        from_settings([{"name": "framestack", "k": 4}])


def test_an_empty_chain_changes_nothing():
    obs = np.ones((2, 2), np.float32)
    wrapper = chain()
    memory, shown = wrapper.init((), obs)
    step = make_step(obs, reward=2.0)
    assert shown is obs and memory == ()
    assert wrapper.step((), memory, obs, np.zeros(2, np.int32), step)[1] == step
    assert wrapper.spec(make_spec(BOX)) == make_spec(BOX)


def test_a_wrapped_native_environment_is_one_that_scans():
    inner = vectorize(factory("CartPole-v1")(), 3)
    shaping = potential_shaping(lambda obs: obs[:, 2], 0.99)
    environment = wrap(inner, chain(shaping, frame_stack(2)))
    key = jax.random.key(0)
    noise = environment.draw(key, 40)

    def rollout(environment):
        state, first = environment.init(key)
        _, steps = jax.lax.scan(lambda state, drawn: environment.step(state, jnp.ones(3, jnp.int32), drawn), state, noise)
        return first, steps

    first, plain = jax.jit(lambda: rollout(inner))()
    first_shown, shown = jax.jit(lambda: rollout(environment))()
    np.testing.assert_array_equal(first_shown, np.tile(first, (1, 2)))
    np.testing.assert_array_equal(shown.next_obs[..., 4:], plain.next_obs)
    acted_on = np.concatenate([np.asarray(first)[None], plain.obs[:-1]])
    phi_after = np.where(plain.terminated, 0.0, plain.next_obs[..., 2])
    np.testing.assert_allclose(shown.reward, plain.reward + 0.99 * phi_after - acted_on[..., 2], rtol=1e-5)
    assert environment.spec.observation_space.shape == (8,)
    assert np.asarray(plain.terminated).any()


def test_a_wrapper_that_learns_cannot_be_built_into_an_environment():
    with pytest.raises(UserError, match="normalize_reward learns"):
        wrap(vectorize(factory("CartPole-v1")(), 1), normalize_reward(0.9))


def test_centre_reward_adds_the_nearness_to_zero_of_each_dimension_of_the_successor() -> None:
    wrapper = centre_reward(0.1, [0, 2], [2.0, 0.5])
    next_obs = jnp.array([[1.0, 9.0, 0.25, 9.0], [0.0, 9.0, 0.5, 9.0]], jnp.float32)
    no = jnp.zeros(2, bool)
    step = Step(next_obs, next_obs, jnp.ones(2), jnp.zeros(2), no, no, jnp.array([True, False]))
    _, shaped = wrapper.step((), (), next_obs, jnp.zeros(2, jnp.int32), step)
    np.testing.assert_allclose(shaped.reward, [1.0 + 0.1 * (0.5 + 0.5), 1.0], rtol=1e-6)
    assert from_settings([wrapper.settings]).name == "centre_reward"
