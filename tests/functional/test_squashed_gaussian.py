import jax
import jax.numpy as jnp
import numpy as np

from thorndike.functional.squashed_gaussian import sample_squashed, squashed_mode


def density(mean: float, log_std: float, action: np.ndarray) -> np.ndarray:
    """In float64, by the change of variables."""
    before, std = np.arctanh(action), np.exp(log_std)
    return np.exp(-0.5 * ((before - mean) / std) ** 2) / (std * np.sqrt(2 * np.pi)) / (1 - action**2)


def test_log_probability_is_that_of_the_change_of_variables():
    noise = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    parameters = np.array([0.3, -0.7, 0.0, -1.0, 0.1, 0.5], np.float32)
    action, log_prob = jax.jit(sample_squashed)(jnp.broadcast_to(parameters, (50, 6)), jnp.asarray(noise))
    before = parameters[:3].astype(np.float64) + np.exp(parameters[3:].astype(np.float64)) * noise
    np.testing.assert_allclose(action, np.tanh(before), rtol=1e-5, atol=1e-6)
    expected = sum(np.log(density(float(parameters[i]), float(parameters[3 + i]), np.tanh(before[:, i]))) for i in range(3))
    np.testing.assert_allclose(log_prob, expected, rtol=1e-4, atol=1e-4)


def test_the_density_integrates_to_one():
    edges = np.tanh(np.linspace(-8, 8, 4001))
    middle, width = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    noise = (np.arctanh(middle) - 0.5) / np.exp(-0.3)
    parameters = jnp.broadcast_to(jnp.array([0.5, -0.3]), (4000, 2))
    _, log_prob = sample_squashed(parameters, jnp.asarray(noise[:, None], jnp.float32))
    assert abs(np.sum(np.exp(np.asarray(log_prob, np.float64)) * width) - 1.0) < 1e-3


def test_log_probability_and_its_gradient_are_right_where_tanh_rounds_to_one():
    def log_prob(mean):
        return sample_squashed(jnp.array([mean, 0.0]), jnp.zeros((1,)))[1]

    # log(1 - tanh(u)^2) tends to 2 (log 2 - u).
    for mean in (20.0, 50.0, -50.0):
        expected = -0.5 * np.log(2 * np.pi) - 2 * (np.log(2.0) - abs(mean))
        np.testing.assert_allclose(log_prob(mean), expected, rtol=1e-6)
        np.testing.assert_allclose(jax.grad(log_prob)(mean), 2.0 * np.sign(mean), rtol=1e-6)


def test_the_deviation_is_kept_within_bounds_and_the_mode_is_the_means_action():
    parameters = jnp.array([0.4, 100.0])
    action, log_prob = sample_squashed(parameters, jnp.ones((1,)))
    np.testing.assert_allclose(action, np.tanh([0.4 + np.exp(2.0)]), rtol=1e-6)
    assert np.isfinite(log_prob)
    np.testing.assert_allclose(squashed_mode(parameters), np.tanh([0.4]), rtol=1e-6)
