import jax.numpy as jnp
import numpy as np

from thorndike.functional.critic_losses import chosen_critics, lowest, lowest_atoms, quantile_errors, squared_errors

GENERATOR = np.random.default_rng(0)


def drawn(*shape: int) -> np.ndarray:
    return GENERATOR.normal(size=shape).astype(np.float32)


def test_the_lowest_critic_counts():
    values = drawn(3, 5, 1)
    np.testing.assert_array_equal(lowest(jnp.asarray(values)), values.min(axis=0))


def test_the_highest_atoms_of_all_critics_together_are_left_out():
    values = drawn(2, 4, 5)
    expected = [sorted([*values[0, row], *values[1, row]])[:7] for row in range(4)]
    np.testing.assert_array_equal(lowest_atoms(jnp.asarray(values), 3), expected)
    assert lowest_atoms(jnp.asarray(values), 0).shape == (4, 10)


def test_squared_errors_are_a_mean_over_valid_rows_and_a_sum_over_critics():
    values, target, weight = drawn(3, 4, 1), drawn(4, 1), np.array([1, 0, 1, 1], np.float32)
    expected = sum(0.5 * np.mean([(values[k, i, 0] - target[i, 0]) ** 2 for i in (0, 2, 3)]) for k in range(3))
    np.testing.assert_allclose(squared_errors(*map(jnp.asarray, (values, target, weight))), expected, rtol=1e-5)


def test_quantile_errors_are_those_of_a_slow_loop():
    values, target, weight = 2 * drawn(2, 3, 4), 2 * drawn(3, 6), np.array([1, 1, 0], np.float32)
    total = 0.0
    for k in range(2):
        for row in range(2):
            for n in range(4):
                error = target[row] - values[k, row, n]
                huber = np.where(np.abs(error) <= 1, 0.5 * error**2, np.abs(error) - 0.5)
                total += np.mean(np.abs((n + 0.5) / 4 - (error < 0)) * huber) / 4 / 2
    np.testing.assert_allclose(quantile_errors(*map(jnp.asarray, (values, target, weight))), total, rtol=1e-5)


def test_a_subset_of_critics_is_drawn_without_replacement():
    params = jnp.arange(12.0).reshape(4, 3)
    chosen = chosen_critics(params, jnp.array([0.1, 0.9, 0.3, 0.8]), 2)
    np.testing.assert_array_equal(chosen, params[jnp.array([1, 3])])
    assert chosen_critics(params, jnp.zeros((0,)), 4) is params
