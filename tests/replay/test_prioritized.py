"""Prioritised replay: rows are drawn exactly in proportion to their priorities, and never before what follows them is stored."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from replay.test_uniform import GAMMA, NUM_ENVS, SPEC, STEPS, rollout, steps_of
from thorndike.replay.prioritized import (
    BRANCHES,
    add_prioritized,
    empty_tree,
    find,
    init_prioritized,
    sample_prioritized,
    set_priorities,
    update_priorities,
)
from thorndike.replay.uniform import row_shapes

RNG = np.random.default_rng(11)
ADD = jax.jit(add_prioritized, static_argnums=2)
SAMPLE = jax.jit(sample_prioritized, static_argnums=(2, 3, 4))
UPDATE = jax.jit(update_priorities)


def filled(total: int, at_once: int = 2, n_step: int = 1, steps: int = STEPS, **flags):
    replay = init_prioritized(row_shapes(SPEC), steps, NUM_ENVS)
    for first in range(0, total, at_once):
        rows = slice(first, first + at_once)
        replay = ADD(replay, rollout(first, at_once, **{name: np.asarray(flag)[rows] for name, flag in flags.items()}), n_step)
    return replay


def draw(replay, count: int = 20_000, n_step: int = 1, beta: float = 1.0, seed: int = 0):
    return jax.tree.map(np.asarray, SAMPLE(replay, jax.random.key(seed), count, NUM_ENVS, n_step, GAMMA, beta))


def leaves(replay) -> np.ndarray:
    return np.asarray(replay.levels[0])[: STEPS * NUM_ENVS]


@pytest.mark.parametrize("size", [1, 8, 9, 100, 5000])
def test_a_place_on_the_line_of_priorities_is_found_as_numpy_finds_it(size):
    priority = (RNG.uniform(size=size) * (RNG.uniform(size=size) < 0.7)).astype(np.float32)
    priority[size // 2] = 0.5
    levels = set_priorities(empty_tree(size), jnp.arange(size), jnp.asarray(priority))
    ends = np.cumsum(priority.astype(np.float64))
    place = RNG.uniform(0, ends[-1] * (1 - 1e-6), 2000)
    found = np.asarray(jax.jit(find)(levels, jnp.asarray(place, jnp.float32)))
    expected = np.searchsorted(ends, place, side="right")
    # Within rounding of a boundary either neighbour is right.
    assert (found != expected).mean() < 1e-2
    before = np.concatenate([[0.0], ends])[found]
    assert (place - before >= -1e-5 * ends[-1]).all() and (ends[found] - place >= -1e-5 * ends[-1]).all()
    assert (priority[found] > 0).all()


def test_a_place_beyond_the_end_is_the_last_row_that_can_be_drawn():
    levels = set_priorities(empty_tree(100), jnp.arange(3, 60), jnp.full((57,), 0.1))
    np.testing.assert_array_equal(find(levels, jnp.array([0.0, 5.7, 99.0])), [3, 59, 59])


def test_every_node_is_the_sum_of_what_is_below_it_after_many_changes():
    levels, priority = empty_tree(700), np.zeros(700, np.float32)
    change = jax.jit(set_priorities)
    for _ in range(30):
        rows, value = RNG.permutation(700)[:64], RNG.exponential(size=64).astype(np.float32)
        priority[rows] = value
        levels = change(levels, jnp.asarray(rows), jnp.asarray(value))
    for level in levels:
        np.testing.assert_allclose(level[: len(priority)], priority, rtol=1e-5)
        priority = np.pad(priority, (0, -len(priority) % BRANCHES)).reshape(-1, BRANCHES).sum(axis=1)


def test_rows_are_drawn_in_proportion_to_their_priorities():
    replay = filled(8)
    error = RNG.exponential(size=STEPS * NUM_ENVS).astype(np.float32)
    replay = UPDATE(replay, jnp.arange(STEPS * NUM_ENVS), jnp.asarray(error), 0.6)
    expected = (error + 1e-6) ** 0.6
    np.testing.assert_allclose(leaves(replay), expected, rtol=1e-5)
    many = jax.vmap(lambda key: SAMPLE(replay, key, 32, NUM_ENVS, 1, GAMMA, 1.0).rows)(jax.random.split(jax.random.key(2), 2000))
    counts, share = np.bincount(np.ravel(many), minlength=len(error)), expected.astype(np.float64) / expected.sum(dtype=np.float64)
    # Stratified draws vary less than independent ones, so this cannot fail by chance more often than 1 in 1,000.
    assert stats.chisquare(counts, counts.sum() * share).pvalue > 1e-3
    assert abs(counts / counts.sum() - share).max() < 0.005


def test_strata_spread_a_minibatch_over_all_priorities():
    rows = draw(filled(8), STEPS * NUM_ENVS).rows
    np.testing.assert_array_equal(np.sort(rows), np.arange(STEPS * NUM_ENVS))


@pytest.mark.parametrize("beta", [0.0, 0.4, 1.0])
def test_importance_weights_undo_the_priorities_as_far_as_beta_says(beta):
    replay = UPDATE(filled(8), jnp.arange(6), jnp.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), 1.0)
    drawn = draw(replay, 500, beta=beta)
    priority = leaves(replay)[drawn.rows]
    np.testing.assert_allclose(drawn.importance, (priority.min() / priority) ** beta, rtol=1e-5)
    assert drawn.importance.max() == 1.0


def test_with_beta_one_the_weighted_mean_of_a_minibatch_is_the_plain_mean_of_the_memory():
    replay = UPDATE(filled(8), jnp.arange(24), jnp.asarray(RNG.exponential(size=24).astype(np.float32)), 0.7)
    drawn = draw(replay, 20_000)
    value = np.sin(np.arange(24))
    assert abs((value[drawn.rows] * drawn.importance).sum() / drawn.importance.sum() - value.mean()) < 0.02


@pytest.mark.parametrize(("total", "n_step", "at_once"), [(2, 1, 2), (26, 1, 2), (4, 3, 2), (8, 3, 2), (26, 3, 2), (24, 3, 8), (6, 6, 1)])
def test_exactly_those_rows_can_be_drawn_whose_future_is_stored(total, n_step, at_once):
    replay = filled(total, at_once, n_step)
    seen = set(steps_of(draw(replay, n_step=n_step).batch).tolist())
    assert seen == set(range(max(0, total - STEPS), total - (n_step - 1)))


def test_a_window_is_that_of_its_row():
    batch = draw(filled(14, n_step=3), n_step=3).batch
    number = batch.obs[:, 0]
    np.testing.assert_allclose(batch.reward, sum(GAMMA**k * (number + 1 + 100 * k) for k in range(3)), rtol=1e-5)
    np.testing.assert_array_equal(batch.next_obs[:, 0], number + 300)


def test_new_rows_begin_with_the_highest_priority_so_far_and_lose_it_when_they_are_written_over():
    replay = UPDATE(filled(8), jnp.arange(3), jnp.array([9.0, 0.5, 0.1]), 1.0)
    assert float(replay.highest) == pytest.approx(9.0)
    replay = ADD(replay, rollout(8, 2), 1)
    np.testing.assert_allclose(leaves(replay)[:6], 9.0, rtol=1e-5)
    np.testing.assert_allclose(leaves(replay)[6:], 1.0)


def test_a_row_drawn_twice_keeps_its_larger_error():
    replay = UPDATE(filled(8), jnp.array([5, 5, 5]), jnp.array([0.2, 0.7, 0.1]), 1.0)
    np.testing.assert_allclose(leaves(replay)[5], 0.7, rtol=1e-4)


def test_dead_rows_are_never_drawn_and_no_error_brings_them_back():
    valid = np.ones((8, NUM_ENVS), bool)
    valid[3, 1] = False
    replay = filled(8, valid=valid)
    replay = UPDATE(replay, jnp.arange(STEPS * NUM_ENVS), jnp.ones(STEPS * NUM_ENVS), 1.0)
    assert 301 not in draw(replay).batch.obs[:, 0]
    assert (draw(replay).batch.weight == 1).all()


def test_an_error_that_is_no_number_changes_nothing():
    replay = UPDATE(filled(8), jnp.array([1, 2]), jnp.array([jnp.nan, jnp.inf]), 0.6)
    np.testing.assert_array_equal(leaves(replay), 1.0)
    assert float(replay.highest) == 1.0


@pytest.mark.slow
def test_drawing_and_changing_cost_hardly_more_from_a_hundred_times_as_many_rows():
    def microseconds(rows: int) -> float:
        levels = set_priorities(empty_tree(rows), jnp.arange(rows), jnp.ones(rows))

        @jax.jit
        def many(levels, key):
            def one(levels, key):
                place = jax.random.uniform(key, (64,)) * levels[-1].sum()
                drawn = find(levels, place)
                return set_priorities(levels, drawn, place / rows), drawn.sum()

            return jax.lax.scan(one, levels, jax.random.split(key, 2000))

        jax.block_until_ready(many(levels, jax.random.key(0)))
        times = []
        for seed in range(5):
            began = time.process_time()
            jax.block_until_ready(many(levels, jax.random.key(seed)))
            times.append((time.process_time() - began) / 2000 * 1e6)
        return min(times)

    small, large = microseconds(10_000), microseconds(1_000_000)
    assert large < 4 * small, f"{small:.0f} microseconds from 10,000 rows, {large:.0f} from 1,000,000"
