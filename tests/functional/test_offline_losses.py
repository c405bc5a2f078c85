import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.offline_losses import advantage_weights, cloning_scale, conservative_gap, expectile_loss

ERRORS = np.array([-2.0, -0.5, 0.1, 3.0, 9.0], np.float32)
WEIGHT = np.array([1.0, 1.0, 1.0, 1.0, 0.0], np.float32)


@pytest.mark.parametrize("expectile", [0.1, 0.5, 0.9])
def test_the_expectile_loss_weighs_errors_by_their_side(expectile):
    slow = [abs(expectile - (error < 0)) * error**2 for error, weight in zip(ERRORS, WEIGHT, strict=True) if weight]
    np.testing.assert_allclose(jax.jit(expectile_loss)(ERRORS, expectile, WEIGHT), np.mean(slow), rtol=1e-6)


@pytest.mark.parametrize(("expectile", "best"), [(0.5, "mean"), (0.9999, "max"), (0.0001, "min")])
def test_the_best_prediction_is_the_mean_at_a_half_and_the_maximum_at_one(expectile, best):
    targets = jnp.asarray([1.0, 2.0, 2.5, 7.0])
    grid = np.linspace(0.0, 8.0, 1601)
    losses = [float(expectile_loss(targets - float(value), expectile, jnp.ones(4))) for value in grid]
    found = grid[int(np.argmin(losses))]
    np.testing.assert_allclose(found, {"mean": 3.125, "max": 7.0, "min": 1.0}[best], atol=0.01)


def test_advantage_weights_are_exponential_clipped_and_have_no_gradient():
    advantage = jnp.asarray([-1.0, 0.0, 0.5, 50.0])
    slow = [min(math.exp(float(a) / 0.5), 20.0) for a in advantage]
    np.testing.assert_allclose(advantage_weights(advantage, 0.5, 20.0), slow, rtol=1e-6)
    slope = jax.grad(lambda a: jnp.sum(advantage_weights(a, 0.5, 20.0)))(advantage)
    np.testing.assert_array_equal(slope, np.zeros(4))


def test_the_conservative_gap_is_log_sum_exp_less_the_value_taken():
    dice = np.random.default_rng(0)
    q, taken = dice.normal(size=(2, 5, 3)).astype(np.float32), dice.normal(size=(2, 5)).astype(np.float32)
    slow = 0.0
    for critic in range(2):
        rows = [math.log(sum(math.exp(value) for value in q[critic, m])) - taken[critic, m] for m in range(5) if WEIGHT[m]]
        slow += np.mean(rows)
    np.testing.assert_allclose(jax.jit(conservative_gap)(q, taken, WEIGHT), slow, rtol=1e-5)


def test_the_sampled_log_sum_is_that_of_the_integral():
    """Weighted by one over their density, draws of any distribution estimate ``log of the integral of exp Q``."""
    actions = np.random.default_rng(1).uniform(-1, 1, 20_000).astype(np.float32)
    q = jnp.asarray(actions**2)[None, None]
    corrected = q - (math.log(0.5) + math.log(len(actions)))
    found = conservative_gap(corrected, jnp.zeros((1, 1)), jnp.ones(1))
    grid = np.linspace(-1, 1, 20_001)
    np.testing.assert_allclose(found, math.log(np.trapezoid(np.exp(grid**2), grid)), atol=0.01)


def test_the_cloning_scale_is_alpha_over_the_mean_size_of_q():
    q = np.array([1.0, -3.0, 2.0, -2.0, 100.0], np.float32)
    np.testing.assert_allclose(cloning_scale(jnp.asarray(q), 2.5, jnp.asarray(WEIGHT)), 2.5 / 2.0, rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda x: cloning_scale(x, 2.5, jnp.asarray(WEIGHT)))(jnp.asarray(q)), np.zeros(5))
