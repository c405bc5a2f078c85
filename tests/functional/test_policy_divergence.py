"""Divergences against sums over actions, and against numerical integration for Gaussians."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.errors import UserError
from thorndike.functional.action_distributions import action_distribution
from thorndike.functional.policy_divergence import gaussian_divergence, policy_divergence

RNG = np.random.default_rng(0)


def probabilities(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max())
    return weights / weights.sum()


@pytest.mark.parametrize(
    "space", [spaces.Discrete(4), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3)], ids=["discrete", "multi", "binary"]
)
def test_of_choices_it_is_the_sum_over_all_of_them(space: gymnasium.Space):
    sizes = [4] if isinstance(space, spaces.Discrete) else [3, 2] if isinstance(space, spaces.MultiDiscrete) else [2, 2, 2]
    first, second = RNG.normal(size=(2, 5, sum(sizes))).astype(np.float32)
    expected = np.zeros(5)
    for row in range(5):
        start = 0
        for size in sizes:
            p, q = probabilities(first[row, start : start + size]), probabilities(second[row, start : start + size])
            expected[row] += sum(p[i] * (np.log(p[i]) - np.log(q[i])) for i in range(size))
            start += size
    np.testing.assert_allclose(policy_divergence(space)(jnp.asarray(first), jnp.asarray(second)), expected, rtol=1e-4, atol=1e-6)


def test_of_gaussians_it_is_the_integral():
    first, second = np.array([[0.3, -0.2, -0.5, 0.1]], np.float32), np.array([[0.1, 0.4, -0.2, 0.3]], np.float32)
    expected = 0.0
    for d in range(2):
        x = np.linspace(-12, 12, 200_001)
        densities = [np.exp(-0.5 * ((x - p[0, d]) / np.exp(p[0, 2 + d])) ** 2) / np.exp(p[0, 2 + d]) for p in (first, second)]
        p, q = (density / np.sqrt(2 * np.pi) for density in densities)
        expected += np.sum(np.where(p > 0, p * (np.log(p + 1e-300) - np.log(q + 1e-300)), 0)) * (x[1] - x[0])
    np.testing.assert_allclose(gaussian_divergence(jnp.asarray(first), jnp.asarray(second)), [expected], rtol=1e-3)


def test_it_is_the_mean_log_ratio_of_the_distribution_itself():
    space = spaces.Box(-1, 1, (2,), np.float32)
    distribution = action_distribution(space)
    first, second = (jnp.asarray(RNG.normal(size=4) * 0.3, jnp.float32) for _ in range(2))
    noise = jnp.asarray(RNG.normal(size=(200_000, 2)), jnp.float32)
    many = [jnp.broadcast_to(p, (len(noise), 4)) for p in (first, second)]
    action = distribution.sample(many[0], noise)
    estimate = np.mean(distribution.log_prob(many[0], action) - distribution.log_prob(many[1], action))
    np.testing.assert_allclose(policy_divergence(space)(first, second), estimate, rtol=0.02)


def test_masked_choices_add_nothing_and_nothing_else_changes():
    first, second = jnp.array([0.3, -1e9, 0.1]), jnp.array([0.5, -1e9, -0.4])
    whole = policy_divergence(spaces.Discrete(3))(first, second)
    np.testing.assert_allclose(whole, policy_divergence(spaces.Discrete(2))(first[::2], second[::2]), rtol=1e-5)


def test_other_spaces_are_refused():
    with pytest.raises(UserError, match="trust region needs Discrete"):
        policy_divergence(spaces.Text(3))
