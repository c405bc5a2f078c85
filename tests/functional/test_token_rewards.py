"""Rewards by token, whitening, group advantages and the adaptive coefficient against slow loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.token_rewards import (
    adapted_coefficient,
    group_advantages,
    kl_estimate,
    leave_one_out_advantages,
    penalized_rewards,
    whitened,
)

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
RNG = np.random.default_rng(5)


def test_the_estimators_agree_with_the_divergence_on_average_and_k2_in_its_gradient():
    policy, reference = (jax.nn.log_softmax(jnp.asarray(RNG.normal(size=6), jnp.float32)) for _ in range(2))
    p, log_ratio = jnp.exp(policy), policy - reference
    exact = float(jnp.sum(p * log_ratio))
    for kind in ("k1", "k3"):
        np.testing.assert_allclose(jnp.sum(p * kl_estimate(log_ratio, kind)), exact, rtol=1e-5)
    assert (kl_estimate(log_ratio, "k3") >= 0).all() and (kl_estimate(log_ratio, "k1") < 0).any()

    def of_samples(theta, kind):
        return jnp.sum(p * kl_estimate(jax.nn.log_softmax(theta) - reference, kind))

    def divergence(theta):
        return jnp.sum(jax.nn.softmax(theta) * (jax.nn.log_softmax(theta) - reference))

    wanted = jax.grad(divergence)(policy)
    np.testing.assert_allclose(jax.grad(of_samples)(policy, "k2"), wanted, atol=1e-6)
    assert np.abs(jax.grad(of_samples)(policy, "k3") - wanted).max() > 1e-2


@COMPILED
def test_the_score_is_given_at_the_last_token_and_the_penalty_at_every_one(compiled):
    score, log_ratio, lengths = RNG.normal(size=4), RNG.normal(size=(4, 5)), [5, 3, 1, 0]
    wanted = np.zeros((4, 5))
    for row, length in enumerate(lengths):
        for t in range(length):
            wanted[row, t] = -0.15 * log_ratio[row, t] + (score[row] if t == length - 1 else 0.0)
    valid = jnp.arange(5)[None] < jnp.array(lengths)[:, None]
    function = jax.jit(penalized_rewards) if compiled else penalized_rewards
    found = function(jnp.asarray(score, jnp.float32), jnp.asarray(log_ratio, jnp.float32), valid, 0.15)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize(("kl", "error"), [(6.0, 0.0), (6.6, 0.1), (60.0, 0.2), (0.0, -0.2), (5.7, -0.05)])
def test_the_coefficient_follows_the_divergence_with_a_limit(kl, error):
    found = adapted_coefficient(jnp.float32(0.15), jnp.float32(kl), 6.0, 128.0, 400.0)
    np.testing.assert_allclose(found, 0.15 * (1 + error * 128 / 400), rtol=1e-5)


@COMPILED
@pytest.mark.parametrize("shift", [True, False])
def test_whitening_looks_at_what_is_not_masked(shift, compiled):
    x, mask = RNG.normal(2.0, 3.0, size=(6, 7)), RNG.random((6, 7)) < 0.6
    values = [x[i, j] for i in range(6) for j in range(7) if mask[i, j]]
    mean = sum(values) / len(values)
    deviation = (sum((value - mean) ** 2 for value in values) / len(values)) ** 0.5
    wanted = np.where(mask, (x - mean) / deviation + (0.0 if shift else mean), 0.0)
    function = jax.jit(whitened, static_argnames="shift_mean") if compiled else whitened
    found = function(jnp.asarray(x, jnp.float32), jnp.asarray(mask, jnp.float32), shift_mean=shift)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


@COMPILED
def test_advantages_within_a_group(compiled):
    reward = RNG.normal(size=(3, 4))
    centred, scaled, left_out = np.zeros((3, 3, 4))
    for p in range(3):
        mean = sum(reward[p]) / 4
        deviation = (sum((r - mean) ** 2 for r in reward[p]) / 3) ** 0.5
        for g in range(4):
            centred[p, g] = reward[p, g] - mean
            scaled[p, g] = centred[p, g] / (deviation + 1e-4)
            left_out[p, g] = reward[p, g] - sum(reward[p, other] for other in range(4) if other != g) / 3
    group, loo = (jax.jit(group_advantages, static_argnames="scale"), jax.jit(leave_one_out_advantages)) if compiled else (
        group_advantages, leave_one_out_advantages
    )  # fmt: skip
    given = jnp.asarray(reward, jnp.float32)
    np.testing.assert_allclose(group(given, scale="none"), centred, atol=1e-6)
    np.testing.assert_allclose(group(given, scale="group"), scaled, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(loo(given), left_out, rtol=1e-5, atol=1e-6)


def test_a_group_of_equal_rewards_teaches_nothing():
    np.testing.assert_array_equal(group_advantages(jnp.ones((2, 4))), 0.0)
