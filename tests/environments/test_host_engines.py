from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from environments.counting_environments import (
    EPISODES_PER_SEED,
    CountingEnv,
    GreedyDiscreteEnv,
    TextEnv,
    WideBoxEnv,
    WrongShapeEnv,
    length_of,
)
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.host.subprocess_engine import SubprocessEngine
from thorndike.environments.host.vector_engine import VectorEngine
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.origins import make_single
from thorndike.errors import UserError

LONGEST = 9
FILE = Path(__file__).parent / "counting_environments.py"
MAKE = partial(make_single, f"{FILE}:CountingEnv", {"longest": LONGEST})
MAKE_DICT = partial(make_single, f"{FILE}:DictCountingEnv", {"longest": LONGEST})


def loop_engine(count: int) -> LoopEngine:
    return LoopEngine([MAKE] * count, "counting")


def sync_engine(mode: AutoresetMode, count: int) -> VectorEngine:
    return VectorEngine(SyncVectorEnv([MAKE] * count, autoreset_mode=mode), "counting")


def async_engine(mode: AutoresetMode, count: int) -> VectorEngine:
    return VectorEngine(AsyncVectorEnv([MAKE] * count, context="forkserver", autoreset_mode=mode), "counting")


COUNTED = {
    "loop": (loop_engine, 50, 500_000),
    "sync same step": (partial(sync_engine, AutoresetMode.SAME_STEP), 40, 130_000),
    "sync next step": (partial(sync_engine, AutoresetMode.NEXT_STEP), 40, 130_000),
    "sync disabled": (partial(sync_engine, AutoresetMode.DISABLED), 40, 130_000),
    "subprocess": (lambda count: SubprocessEngine([MAKE] * count, "counting"), 2, 10_000),
    "async next step": (partial(async_engine, AutoresetMode.NEXT_STEP), 2, 10_000),
    "async disabled": (partial(async_engine, AutoresetMode.DISABLED), 2, 10_000),
}
POOLED = 80_000


def false_transitions(acted_on: np.ndarray, step) -> int:
    """How many of the valid rows are no step of the counting environment, or say a wrong thing about its end."""
    episode, count = acted_on.T.astype(np.int64)
    ends = count + 1 == length_of(episode, LONGEST)
    right = (step.next_obs[:, 0] == episode) & (step.next_obs[:, 1] == count + 1)
    right &= (step.reward == count + 1) & (step.cost == count + 1.5)
    right &= (step.terminated == (ends & (episode % 3 != 1))) & (step.truncated == (ends & (episode % 3 != 0)))
    return int(np.sum(step.valid & ~right))


def broken_starts(acted_on: np.ndarray, step, ended: np.ndarray) -> int:
    """How many of the valid rows after an end are no first step of the episode after."""
    begins = step.valid & (ended >= 0)
    return int(np.sum(begins & ((acted_on[:, 0] != ended + 1) | (acted_on[:, 1] != 0))))


@pytest.mark.parametrize("name", COUNTED)
def test_a_counting_environment_gives_no_false_transition(name):
    build, num_envs, steps = COUNTED[name]
    engine = build(num_envs)
    obs = engine.reset(range(num_envs))
    np.testing.assert_array_equal(obs[:, 0], np.arange(num_envs) * EPISODES_PER_SEED)
    actions = np.zeros(num_envs, np.int32)
    seen = false = broken = ends = dead = 0
    ended = np.full(num_envs, -1.0)
    while seen < steps:
        step = engine.step(actions)
        false += false_transitions(obs, step)
        broken += broken_starts(obs, step, ended)
        done = step.terminated | step.truncated
        ended = np.where(done, step.next_obs[:, 0], np.where(step.valid, -1.0, ended))
        seen += int(step.valid.sum())
        ends += int(done.sum())
        dead += int((~step.valid).sum())
        assert not done[~step.valid].any()
        obs = step.obs
    engine.close()
    assert (false, broken) == (0, 0)
    assert ends > seen / LONGEST
    assert abs(dead - (ends if "next" in name else 0)) <= num_envs


def test_the_counted_steps_are_a_million_in_all():
    assert sum(steps for _, _, steps in COUNTED.values()) + POOLED == 1_000_000


def test_no_false_transition_in_a_pool_with_deaths_time_limits_and_both():
    pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_engine import EnvPoolEngine

    limit, num_envs = 12, 40
    engine = EnvPoolEngine("CartPole-v1", num_envs, reference=gymnasium.make("CartPole-v1"), max_episode_steps=limit)
    obs, clock, rng = engine.reset(range(num_envs)), np.zeros(num_envs, int), np.random.default_rng(0)
    assert len(np.unique(obs, axis=0)) == num_envs
    kinds = np.zeros(4, int)
    while kinds.sum() < POOLED:
        actions = (rng.random(num_envs) < 0.85).astype(np.int32)
        step = engine.step(actions)
        clock = np.where(step.valid, clock + 1, 0)
        after, dead, sure = cartpole_after(obs, actions)
        assert np.abs(np.where(step.valid[:, None], step.next_obs - after, 0)).max() < 1e-4
        np.testing.assert_array_equal(step.terminated & sure, dead & step.valid & sure)
        np.testing.assert_array_equal(step.truncated, step.valid & (clock == limit))
        np.testing.assert_array_equal(step.reward, step.valid.astype(np.float32))
        kinds += np.bincount((step.terminated + 2 * step.truncated)[step.valid], minlength=4)
        assert np.abs(step.obs[step.truncated & ~step.terminated]).max(initial=0) <= 0.05
        assert np.abs(step.obs[~step.valid]).max(initial=0) <= 0.05
        obs, clock = step.obs, np.where(step.terminated | step.truncated, 0, clock)
    engine.close()
    assert (kinds > 100).all(), kinds


def cartpole_after(obs: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CartPole's next state, whether it is dead, and whether float32 can tell."""
    x, speed, angle, spin = obs.T.astype(np.float64)
    push = (np.where(actions == 1, 10.0, -10.0) + 0.05 * spin**2 * np.sin(angle)) / 1.1
    spin_rate = (9.8 * np.sin(angle) - np.cos(angle) * push) / (0.5 * (4 / 3 - 0.1 * np.cos(angle) ** 2 / 1.1))
    acceleration = push - 0.05 * spin_rate * np.cos(angle) / 1.1
    after = np.stack([x + 0.02 * speed, speed + 0.02 * acceleration, angle + 0.02 * spin, spin + 0.02 * spin_rate], -1)
    edge = 12 * 2 * np.pi / 360
    return after, (np.abs(after[:, 0]) > 2.4) | (np.abs(after[:, 2]) > edge), np.abs(np.abs(after[:, 2]) - edge) > 1e-5


def test_the_same_seeds_give_the_same_episodes_again_and_others_do_not():
    engine = LoopEngine([lambda: gymnasium.make("CartPole-v1")] * 2, "CartPole-v1")
    first = engine.reset([3, 5])
    engine.step(np.zeros(2, np.int32))
    np.testing.assert_array_equal(engine.reset([3, 5]), first)
    assert not np.array_equal(engine.reset([3, 6])[1], first[1])
    with pytest.raises(ValueError, match="one seed for each of the 2"):
        engine.reset([1])


def test_the_loop_gives_what_gymnasiums_own_vector_gives():
    make = partial(gymnasium.make, "CartPole-v1", max_episode_steps=20)
    vector = SyncVectorEnv([make] * 4, autoreset_mode=AutoresetMode.SAME_STEP)
    engine, rng = LoopEngine([make] * 4, "CartPole-v1"), np.random.default_rng(0)
    np.testing.assert_array_equal(engine.reset([1, 2, 3, 4]), vector.reset(seed=[1, 2, 3, 4])[0])
    for _ in range(200):
        actions = rng.integers(0, 2, 4)
        obs, reward, terminated, truncated, infos = vector.step(actions)
        step = engine.step(actions)
        for ours, theirs in ((step.obs, obs), (step.reward, reward), (step.terminated, terminated), (step.truncated, truncated)):
            np.testing.assert_array_equal(ours, theirs)
        for row in np.flatnonzero(terminated | truncated):
            np.testing.assert_array_equal(step.next_obs[row], infos["final_obs"][row])


@pytest.mark.parametrize("limit", [5, 7, None])
def test_a_host_step_is_a_native_step(limit):
    """The same task compiled and on the host: every field of every step, with a time limit below, at and without the end."""
    dynamics = factory("probe/Counting-v0")(length=7)
    environment = vectorize(dynamics, 2, limit)

    class Counter(CountingEnv):
        observation_space = dynamics.observation_space

        def __init__(self):
            super().__init__()
            self.observation_space = dynamics.observation_space

        def observe(self):
            return np.array([self.count], np.float32)

        def step(self, action):
            self.count += 1
            return self.observe(), float(self.count), self.count >= 7, False, {}

    engine = LoopEngine([lambda: make_single(Counter, {}, limit)] * 2, "counter")
    noise = environment.draw(jax.random.key(0), 20)
    state, obs = environment.init(jax.random.key(0))
    np.testing.assert_array_equal(engine.reset([0, 1]), obs)
    native_step = jax.jit(environment.step)
    for t in range(20):
        state, compiled = native_step(state, jnp.zeros(2, jnp.int32), jax.tree.map(lambda leaf, t=t: leaf[t], noise))
        hosted = engine.step(np.zeros(2, np.int32))
        for ours, theirs in zip(hosted[:7], compiled[:7], strict=True):
            np.testing.assert_array_equal(ours, theirs)
            assert ours.dtype == theirs.dtype


def check_dict(batch: dict, episode: np.ndarray, count: np.ndarray) -> None:
    np.testing.assert_array_equal(batch["state"], np.stack([episode, count], -1))
    np.testing.assert_array_equal(batch["picture"][:, 0, 0, 0], count)
    np.testing.assert_array_equal(batch["parts"][0], count)
    np.testing.assert_array_equal(batch["parts"][1]["bits"], np.repeat(count[:, None] % 2, 3, 1))
    assert [leaf.dtype for leaf in jax.tree.leaves(batch)] == [np.int32, np.int32, np.uint8, np.float32]


@pytest.mark.parametrize(
    "build",
    [
        lambda: LoopEngine([MAKE_DICT] * 3, "dict"),
        *(lambda mode=mode: VectorEngine(SyncVectorEnv([MAKE_DICT] * 3, autoreset_mode=mode), "dict") for mode in AutoresetMode),
        lambda: SubprocessEngine([MAKE_DICT] * 3, "dict"),
    ],
    ids=["loop", *(mode.name for mode in AutoresetMode), "subprocess"],
)
def test_nested_observations_are_pytrees_of_stacked_arrays(build):
    engine = build()
    obs = engine.reset([1, 2, 3])
    check_dict(obs, np.array([1, 2, 3]) * EPISODES_PER_SEED, np.zeros(3))
    for _ in range(25):
        episode, count = obs["state"].T.copy()
        step = engine.step(np.zeros(3, np.int32))
        check_dict(step.next_obs, np.where(step.valid, episode, episode + 1), np.where(step.valid, count + 1, 0))
        check_dict(step.obs, *step.obs["state"].T)
        obs = step.obs
    engine.close()


def test_returned_arrays_are_never_written_again():
    for engine in (loop_engine(2), sync_engine(AutoresetMode.SAME_STEP, 2)):
        first = engine.reset([0, 1])
        kept = [first, *jax.tree.leaves(engine.step(np.zeros(2, np.int32)))]
        copies = [array.copy() for array in kept]
        for _ in range(20):
            engine.step(np.zeros(2, np.int32))
        for array, copied in zip(kept, copies, strict=True):
            np.testing.assert_array_equal(array, copied)


def test_a_cut_by_the_limit_in_the_step_of_a_death_has_both_flags():
    engine = LoopEngine([lambda: make_single(CountingEnv, {}, 1)] * 1, "counting")
    engine.reset([0])
    step = engine.step(np.zeros(1, np.int32))
    assert bool(step.terminated[0]) and bool(step.truncated[0])


def test_discrete_actions_count_from_zero_whatever_the_space():
    engine = LoopEngine([GreedyDiscreteEnv] * 2, "greedy")
    np.testing.assert_array_equal(engine.reset([0, 0]), [1, 1])
    np.testing.assert_array_equal(engine.step(np.array([0, 1], np.int32)).reward, [5, 6])


def test_box_actions_are_clipped_to_the_bounds():
    for engine in (LoopEngine([WideBoxEnv] * 3, "wide"), VectorEngine(SyncVectorEnv([WideBoxEnv] * 3), "wide")):
        engine.reset([0, 0, 0])
        np.testing.assert_array_equal(engine.step(np.array([[-9.0], [1.5], [9.0]], np.float32)).reward, [-2, 1.5, 2])


@pytest.mark.parametrize(("environment", "words"), [(WrongShapeEnv, r"shape \(2,\), but its space says \(1,\)"), (TextEnv, "not Text")])
def test_an_environment_that_cannot_be_shown_is_named(environment, words):
    with pytest.raises(UserError, match=words):
        LoopEngine([environment], "mine").reset([0])


def test_same_step_without_final_obs_is_named():
    vector = SyncVectorEnv([CountingEnv] * 1, autoreset_mode=AutoresetMode.NEXT_STEP)
    vector.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
    engine = VectorEngine(vector, "mine")
    engine.reset([1])
    with pytest.raises(UserError, match="final_obs"):
        for _ in range(LONGEST):
            engine.step(np.zeros(1, np.int32))


def test_a_vector_of_its_own_making_is_accepted():
    """Gymnasium's CartPoleVectorEnv: one seed for all, NEXT_STEP."""
    engine = VectorEngine(gymnasium.make_vec("CartPole-v1", 4, vectorization_mode="vector_entry_point"), "CartPole-v1")
    obs, dead = engine.reset([7, 8, 9, 10]), 0
    for _ in range(60):
        actions = np.ones(4, np.int32)
        step = engine.step(actions)
        after, died, sure = cartpole_after(obs, actions)
        assert np.abs((step.next_obs - after)[step.valid]).max() < 1e-5
        np.testing.assert_array_equal(step.terminated & sure, died & step.valid & sure)
        dead += int((~step.valid).sum())
        obs = step.obs
    assert dead > 4


# EnvPool


def pool_and_reference(id: str):
    pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_engine import EnvPoolEngine

    reference = gymnasium.make(id)
    return EnvPoolEngine(id, 1, reference=reference), reference


def set_cheetah(environment, obs):
    environment.set_state(np.concatenate([[0.0], obs[:8]]), obs[8:])


def set_cart(environment, obs):
    environment.set_state(obs[:2], obs[2:])


def set_pendulum(environment, obs):
    environment.state = np.array([np.arctan2(obs[1], obs[0]), obs[2]])


@pytest.mark.parametrize(
    ("id", "set_state"), [("HalfCheetah-v5", set_cheetah), ("InvertedPendulum-v5", set_cart), ("Pendulum-v1", set_pendulum)]
)
def test_a_pool_steps_as_gymnasium_does_from_the_same_states(id, set_state):
    engine, reference = pool_and_reference(id)
    obs, rng = engine.reset([3]), np.random.default_rng(0)
    reference.reset(seed=0)
    for _ in range(60):
        action = rng.uniform(-1, 1, (1, *engine.spec.action_space.shape)).astype(np.float32)
        set_state(reference.unwrapped, obs[0].astype(np.float64))
        expected, reward, terminated, _, _ = reference.unwrapped.step(action[0])
        step = engine.step(action)
        if step.valid[0]:
            np.testing.assert_allclose(step.next_obs[0], expected, rtol=1e-3, atol=1e-3)
            np.testing.assert_allclose(step.reward[0], reward, rtol=1e-3, atol=1e-3)
            assert bool(step.terminated[0]) == terminated
        obs = step.obs
    engine.close()


def test_a_pool_honours_a_seed_for_each_environment():
    pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_engine import EnvPoolEngine

    both, one = EnvPoolEngine("CartPole-v1", 2), EnvPoolEngine("CartPole-v1", 1)
    seeds = [11, 2**31 + 4]
    first = both.reset(seeds)
    np.testing.assert_array_equal(one.reset(seeds[1:])[0], first[1])
    both.step(np.zeros(2, np.int32))
    np.testing.assert_array_equal(both.reset(seeds), first)


def test_pictures_of_a_pool_have_their_channels_last():
    pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_engine import EnvPoolEngine

    engine = EnvPoolEngine("Pong-v5", 2)
    obs = engine.reset([0, 1])
    assert obs.shape == (2, *engine.spec.observation_space.shape) == (2, 84, 84, 4)
    assert obs.dtype == np.uint8 and obs.flags.c_contiguous


def test_the_list_of_pool_ids_is_the_pools_own():
    envpool = pytest.importorskip("envpool")
    from thorndike.environments.host.envpool_ids import SAME_AS_GYMNASIUM, pool_ids

    if envpool.__version__ != "1.2.5":
        pytest.skip("the list is of EnvPool 1.2.5")
    assert pool_ids() == set(envpool.list_all_envs())
    assert pool_ids() >= SAME_AS_GYMNASIUM and set(gymnasium.registry) >= SAME_AS_GYMNASIUM
