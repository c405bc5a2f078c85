"""Munchausen terms against the paper's formulas in NumPy."""

import jax.numpy as jnp
import numpy as np

from thorndike.functional.munchausen import log_policy_reward, soft_bonus, soft_policy

Q = np.array([[1.0, 1.2, -0.3], [0.0, 0.0, 0.0], [5.0, -1e9, 4.9]], np.float32)
TEMPERATURE = 0.5


def policy_by_hand() -> np.ndarray:
    weights = np.exp((Q - Q.max(axis=1, keepdims=True)).astype(np.float64) / TEMPERATURE)
    return weights / weights.sum(axis=1, keepdims=True)


def test_the_policy_is_a_softmax_and_its_bonus_the_entropy():
    policy = policy_by_hand()
    np.testing.assert_allclose(soft_policy(jnp.asarray(Q), TEMPERATURE), policy, rtol=1e-5)
    logs = np.log(np.where(policy > 0, policy, 1.0))
    np.testing.assert_allclose(soft_bonus(jnp.asarray(Q), TEMPERATURE), -TEMPERATURE * (policy * logs).sum(axis=1), rtol=1e-5)


def test_the_log_policy_of_the_action_taken_is_clipped_from_below():
    found = log_policy_reward(jnp.asarray(Q), jnp.array([0, 2, 1]), 0.9, TEMPERATURE, -1.0)
    policy = policy_by_hand()
    np.testing.assert_allclose(found[:2], 0.9 * TEMPERATURE * np.log(policy[[0, 1], [0, 2]]), rtol=1e-5)
    np.testing.assert_allclose(found[2], -0.9, rtol=1e-6)
