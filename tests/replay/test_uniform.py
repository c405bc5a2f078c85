"""The ring of transitions: every sampled row is one that really happened, all equally often, at its true discount."""

from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from thorndike.replay.uniform import ReplayBuffer, add, init_replay, row_shapes, rows_of, sample
from thorndike.types import EnvSpec, Rollout, Step

STEPS, NUM_ENVS, GAMMA = 8, 3, 0.9
SPEC = EnvSpec("numbers", spaces.Box(0, np.inf, (1,)), spaces.Discrete(100), NUM_ENVS)


def rollout(first: int, length: int, terminated=None, truncated=None, valid=None) -> Rollout:
    """Step ``t`` of environment ``b`` has the number ``100 t + b``: its observation, its action modulo 100, its reward 1 + number."""
    number = (100 * np.arange(first, first + length)[:, None] + np.arange(NUM_ENVS)).astype(np.float32)
    no = np.zeros((length, NUM_ENVS), bool)
    obs = jnp.asarray(number)[..., None]
    flags = (no if flag is None else np.asarray(flag) for flag in (terminated, truncated))
    alive = ~no if valid is None else np.asarray(valid)
    step = Step(obs + 100, obs + 100, jnp.asarray(number + 1), jnp.zeros_like(number), *map(jnp.asarray, flags), jnp.asarray(alive))
    return Rollout(obs, jnp.asarray(number % 100, jnp.int32), {}, step, ())


def empty(steps: int = STEPS) -> ReplayBuffer:
    return init_replay(row_shapes(SPEC), steps, NUM_ENVS)


def filled(total: int, at_once: int = 2, **flags) -> ReplayBuffer:
    """A ring of 8 steps after ``total`` steps, written ``at_once`` at a time."""
    buffer, write = empty(), jax.jit(add)
    for first in range(0, total, at_once):
        rows = slice(first, first + at_once)
        buffer = write(buffer, rollout(first, at_once, **{name: np.asarray(flag)[rows] for name, flag in flags.items()}))
    return buffer


def draw(buffer: ReplayBuffer, count: int = 20_000, n_step: int = 1, seed: int = 0):
    take = jax.jit(partial(sample, batch_size=count, num_envs=NUM_ENVS, n_step=n_step, gamma=GAMMA))
    return jax.tree.map(np.asarray, take(buffer, jax.random.key(seed)))


def steps_of(batch) -> np.ndarray:
    """Which time step each sampled row is."""
    return batch.obs[:, 0].astype(int) // 100


def test_a_row_is_kept_with_its_spaces_dtypes():
    spec = EnvSpec("x", spaces.Dict({"p": spaces.Box(0, 255, (4, 4), np.uint8), "n": spaces.Discrete(3)}), spaces.Discrete(2), 2)
    rows = init_replay(row_shapes(spec), 5, 2).rows
    assert rows["obs"]["p"].shape == (10, 4, 4)
    assert {name: rows["obs"][name].dtype for name in ("p", "n")} == {"p": jnp.uint8, "n": jnp.int32}
    assert (rows["reward"].dtype, rows["terminated"].dtype, rows["action"].dtype) == (jnp.float32, jnp.bool_, jnp.int32)


@pytest.mark.parametrize("total", [2, 6, 8, 10, 26])
def test_the_ring_keeps_the_newest_steps(total):
    buffer = filled(total)
    assert int(buffer.size) == min(total, STEPS)
    assert int(buffer.position) == total % STEPS
    seen = set(steps_of(draw(buffer)).tolist())
    assert seen == set(range(max(0, total - STEPS), total)), "every stored step is drawn, and no other"


def test_a_whole_row_stays_together():
    batch = draw(filled(14))
    number = batch.obs[:, 0]
    np.testing.assert_array_equal(batch.action, number % 100)
    np.testing.assert_array_equal(batch.reward, number + 1)
    np.testing.assert_array_equal(batch.next_obs[:, 0], number + 100)
    np.testing.assert_array_equal(batch.weight, 1)
    np.testing.assert_allclose(batch.discount, GAMMA)


@pytest.mark.parametrize(("total", "n_step", "drawable"), [(4, 1, 4), (26, 1, 8), (26, 3, 6), (6, 3, 4)])
def test_every_row_is_drawn_equally_often(total, n_step, drawable):
    batch = draw(filled(total), 24_000, n_step)
    _, counts = np.unique(batch.obs[:, 0], return_counts=True)
    assert len(counts) == drawable * NUM_ENVS
    assert stats.chisquare(counts).pvalue > 1e-3


def test_keys_give_different_batches_and_the_same_key_the_same():
    buffer = filled(8)
    first, again, other = draw(buffer, 50), draw(buffer, 50), draw(buffer, 50, seed=1)
    np.testing.assert_array_equal(first.obs, again.obs)
    assert not np.array_equal(first.obs, other.obs)


@pytest.mark.parametrize("total", [4, 8, 14, 24])
def test_a_window_never_crosses_the_write_head(total):
    """Without an end, a 3-step return is that of three consecutive numbers: across the head they would jump back."""
    batch = draw(filled(total), n_step=3)
    number = batch.obs[:, 0]
    rewards = [number + 1 + 100 * k for k in range(3)]
    np.testing.assert_allclose(batch.reward, sum(GAMMA**k * r for k, r in enumerate(rewards)), rtol=1e-5)
    np.testing.assert_array_equal(batch.next_obs[:, 0], number + 300)
    np.testing.assert_allclose(batch.discount, GAMMA**3, rtol=1e-6)
    oldest = max(0, total - STEPS)
    assert set(steps_of(batch).tolist()) == set(range(oldest, total - 2))


def test_a_window_stops_at_an_end_and_bootstraps_only_from_a_time_limit():
    """Environment 0 dies at step 5, environment 1 is cut there, environment 2 goes on."""
    terminated, truncated = np.zeros((2, 8, NUM_ENVS), bool)
    terminated[5, 0] = truncated[5, 1] = True
    batch = draw(filled(8, terminated=terminated, truncated=truncated), n_step=3)
    for t, used in ((3, 3), (4, 2), (5, 1)):
        for env, ends in ((0, "death"), (1, "limit"), (2, "no")):
            rows = np.flatnonzero(batch.obs[:, 0] == 100 * t + env)
            assert len(rows) > 0
            length = 3 if ends == "no" else used
            number = 100 * t + env
            expected = sum(GAMMA**k * (number + 1 + 100 * k) for k in range(length))
            np.testing.assert_allclose(batch.reward[rows], expected, rtol=1e-5)
            np.testing.assert_array_equal(batch.next_obs[rows, 0], number + 100 * length)
            np.testing.assert_allclose(batch.discount[rows], 0 if ends == "death" else GAMMA**length, rtol=1e-6)


def test_one_step_rows_bootstrap_from_a_time_limit_but_not_from_a_death():
    terminated, truncated = np.zeros((2, 4, NUM_ENVS), bool)
    terminated[:, 0] = truncated[:, 1] = True
    batch = draw(filled(4, terminated=terminated, truncated=truncated))
    env = batch.action % 100
    np.testing.assert_allclose(batch.discount, np.where(env == 0, 0, GAMMA), rtol=1e-6)


@pytest.mark.parametrize("n_step", [1, 3])
def test_dead_rows_have_no_weight(n_step):
    valid = np.ones((8, NUM_ENVS), bool)
    valid[3, 1] = False
    batch = draw(filled(8, valid=valid), n_step=n_step)
    np.testing.assert_array_equal(batch.weight, batch.obs[:, 0] != 301)


def test_writing_at_once_or_in_parts_is_the_same():
    once, parts = jax.jit(add)(empty(), rollout(0, 8)), filled(8)
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(parts), strict=True):
        np.testing.assert_array_equal(a, b)


def test_rows_of_a_rollout_keep_both_kinds_of_end_apart():
    yes, no = np.ones((1, NUM_ENVS), bool), np.zeros((1, NUM_ENVS), bool)
    cut, dead = rows_of(rollout(0, 1, no, yes)), rows_of(rollout(0, 1, yes, no))
    assert bool(cut["done"].all()) and not bool(cut["terminated"].any())
    assert bool(dead["done"].all()) and bool(dead["terminated"].all())
