import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.normalization import (
    Moments,
    add_row,
    empty_moments,
    merge_moments,
    moments_of,
    normalize,
    pool_moments,
    running_returns,
    scale,
)


@pytest.fixture(autouse=True)
def strict_ranks():
    with jax.numpy_rank_promotion("raise"):
        yield


def assert_moments(moments: Moments, rows: np.ndarray, rtol: float = 1e-5) -> None:
    rows = rows.astype(np.float64)
    assert float(moments.seen) == len(rows)
    np.testing.assert_allclose(moments.mean, rows.mean(0), rtol=rtol, atol=1e-6)
    np.testing.assert_allclose(moments.variance, rows.var(0), rtol=rtol, atol=1e-6)


def test_moments_of_valid_rows_equal_numpy():
    rng = np.random.default_rng(0)
    rows, valid = rng.normal(3, 2, (7, 5, 4)).astype(np.float32), rng.random((7, 5)) < 0.7
    assert_moments(moments_of(rows, valid), rows[valid])


def test_moments_of_no_valid_row_change_nothing_when_merged():
    rows = np.ones((3, 2), np.float32)
    before = Moments(jnp.float32(10), jnp.full(2, 4.0), jnp.full(2, 9.0))
    after = merge_moments(before, moments_of(rows, np.zeros(3, bool)))
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_merging_many_batches_equals_numpy_on_all_rows():
    rng = np.random.default_rng(1)
    batches = [rng.normal(offset, 1 + abs(offset), (size, 3)).astype(np.float32) for offset, size in ((0, 1), (5, 40), (-3, 7), (2, 1000))]
    moments = empty_moments((3,))
    for batch in batches:
        moments = merge_moments(moments, moments_of(batch, np.ones(len(batch), bool)))
    assert_moments(moments, np.concatenate(batches))


def test_merging_is_symmetric():
    rng = np.random.default_rng(2)
    a, b = (moments_of(rng.normal(size=(n, 2)).astype(np.float32), np.ones(n, bool)) for n in (9, 31))
    for left, right in zip(merge_moments(a, b), merge_moments(b, a), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-6, atol=1e-7)


def test_a_large_offset_keeps_the_variance():
    rng = np.random.default_rng(3)
    rows = (1e4 + rng.normal(size=(64, 8, 1))).astype(np.float32)
    moments = empty_moments((1,), (8,))
    for row in rows:
        moments = jax.jit(add_row)(moments, row, np.ones(8, bool))
    assert_moments(pool_moments(moments), rows.reshape(-1, 1), rtol=2e-2)


def test_rows_added_one_by_one_equal_numpy_and_skip_invalid_ones():
    rng = np.random.default_rng(4)
    rows, valid = rng.normal(-2, 3, (50, 6, 2)).astype(np.float32), rng.random((50, 6)) < 0.5
    moments = empty_moments((2,), (6,))
    for row, mask in zip(rows, valid, strict=True):
        moments = jax.jit(add_row)(moments, row, mask)
    np.testing.assert_array_equal(moments.seen, valid.sum(0))
    assert_moments(pool_moments(moments), rows[valid], rtol=1e-4)


def test_pooling_nothing_is_empty():
    for pooled, empty in zip(pool_moments(empty_moments((2,), (3,))), empty_moments((2,)), strict=True):
        np.testing.assert_array_equal(pooled, empty)


def test_normalize_and_scale_follow_their_formulas():
    moments = Moments(jnp.float32(5), jnp.array([1.0, -1.0]), jnp.array([4.0, 0.25]))
    rows = np.array([[3.0, -1.5], [1001.0, -1.0]], np.float32)
    np.testing.assert_allclose(normalize(rows, moments, 0.0, 10.0), [[1.0, -1.0], [10.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(scale(rows, moments, 0.0, 5.0), [[1.5, -3.0], [5.0, -2.0]], rtol=1e-6)


def test_empty_moments_change_nothing():
    rows = np.array([[0.5, -2.0]], np.float32)
    np.testing.assert_allclose(normalize(rows, empty_moments((2,))), rows, rtol=1e-6)


def test_running_returns_equal_a_loop_and_restart_after_an_end():
    rng = np.random.default_rng(5)
    reward, done, before, gamma = rng.normal(size=(20, 3)).astype(np.float32), rng.random((20, 3)) < 0.2, np.ones(3, np.float32), 0.9
    expected, current = [], before.astype(np.float64)
    for row, ends in zip(reward, done, strict=True):
        current = gamma * current + row
        expected.append(current)
        current = np.where(ends, 0.0, current)
    after, returns = running_returns(reward, done, before, gamma)
    np.testing.assert_allclose(returns, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(after, current, rtol=1e-5, atol=1e-6)
