"""Random orders: every row once an epoch, each place equally likely."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from thorndike.functional.shuffling import minibatches, permutations

SIZES = (1, 2, 3, 64, 100, 4096, 5000, 70_000)


@pytest.mark.parametrize("n", SIZES)
def test_every_row_comes_exactly_once(n):
    orders = jax.jit(permutations, static_argnums=(1, 2))(jax.random.key(n), 3, n)
    assert orders.dtype == jnp.int32
    np.testing.assert_array_equal(np.sort(orders, axis=-1), np.tile(np.arange(n), (3, 1)))


@pytest.mark.parametrize("n", [2, 3, 5])
def test_every_order_of_a_few_rows_is_equally_likely(n):
    draws = 6_000
    orders = np.asarray(jax.jit(permutations, static_argnums=(1, 2))(jax.random.key(0), draws, n))
    numbers = orders @ n ** np.arange(n)
    _, counts = np.unique(numbers, return_counts=True)
    assert len(counts) == int(np.prod(np.arange(1, n + 1)))
    assert stats.chisquare(counts).pvalue > 1e-3


@pytest.mark.parametrize("n", [64, 1000, 4096, 5000])
def test_each_row_is_equally_likely_in_each_place(n):
    """Rows and places in eight groups: 64 counts that would be equal but for chance."""
    draws = 400
    orders = np.asarray(jax.jit(permutations, static_argnums=(1, 2))(jax.random.key(1), draws, n))
    places, rows = np.arange(n) * 8 // n, orders * 8 // n
    counts = np.bincount((places * 8 + rows).ravel(), minlength=64).reshape(8, 8)
    group = np.bincount(places)
    expected = draws * np.outer(group, group) / n
    # Rows of an order are no independent draws: the counts of a permutation vary by (n - 1) / n * (1 - 1/8)^2 less than Poisson's.
    statistic = np.sum((counts - expected) ** 2 / expected) * (n - 1) / n
    assert stats.chi2(49).sf(statistic) > 1e-3
    assert stats.chi2(49).cdf(statistic) > 1e-3, "too even to be random"


def test_keys_give_different_orders():
    a, b = (permutations(jax.random.key(seed), 1, 100) for seed in (0, 1))
    assert not np.array_equal(a, b)


@pytest.mark.parametrize(("n", "batch_size"), [(12, 4), (6, 6), (8, 1)])
def test_each_epochs_minibatches_hold_every_row_once(n, batch_size):
    epochs = 5
    order = jax.jit(minibatches, static_argnums=(1, 2, 3))(jax.random.key(0), n, epochs, batch_size)
    assert order.shape == (epochs * n // batch_size, batch_size)
    by_epoch = np.asarray(order).reshape(epochs, n)
    np.testing.assert_array_equal(np.sort(by_epoch, axis=1), np.tile(np.arange(n), (epochs, 1)))
    assert len({tuple(order) for order in by_epoch.tolist()}) > 1, "each epoch has its own order"
