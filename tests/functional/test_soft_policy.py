import jax.numpy as jnp
import numpy as np
import optax
from gymnasium import spaces

from thorndike.functional.soft_policy import improve_policy, policy_loss, soft_policy, temperature
from thorndike.functional.squashed_gaussian import sample_squashed

BOX = spaces.Box(-1, 1, (2,), np.float32)
OBS, NOISE = jnp.zeros((4, 1)), jnp.asarray(np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32))
WEIGHT = jnp.array([1.0, 1.0, 0.0, 1.0])


def apply(params, obs):
    return jnp.broadcast_to(params, (obs.shape[0], 4))


def q_of(obs, action):
    return action[:, 0] - jnp.square(action[:, 1])


def test_the_loss_is_temperature_times_log_probability_less_q_over_valid_rows():
    params = jnp.array([0.2, -0.1, -0.5, 0.3])
    loss, mean_log_prob = policy_loss(params, apply, q_of, jnp.float32(0.7), OBS, NOISE, WEIGHT)
    action, log_prob = sample_squashed(apply(params, OBS), NOISE)
    rows = np.asarray(0.7 * log_prob - q_of(OBS, action))[[0, 1, 3]]
    np.testing.assert_allclose(loss, rows.mean(), rtol=1e-6)
    np.testing.assert_allclose(mean_log_prob, np.asarray(log_prob)[[0, 1, 3]].mean(), rtol=1e-6)


def improved(log_std: float, heat):
    optimizer = optax.scale_by_adam()
    policy = soft_policy(jnp.array([0.0, 0.0, log_std, log_std]), 1.0, optimizer)
    return improve_policy(policy, apply, q_of, OBS, NOISE, WEIGHT, heat, optimizer, jnp.float32(0.01))


def test_a_learnt_temperature_rises_while_entropy_is_below_its_target_and_falls_above():
    heat = temperature("auto", "auto", BOX)
    assert heat.target_entropy == -2.0
    narrow, metrics = improved(-5.0, heat)
    assert metrics["train/entropy"] < -2.0
    assert narrow.log_ent_coef.params > 0.0
    wide, metrics = improved(0.0, heat)
    assert metrics["train/entropy"] > -2.0
    assert wide.log_ent_coef.params < 0.0
    assert metrics["train/ent_coef"] == 1.0


def test_a_given_temperature_stays():
    policy, metrics = improved(0.0, temperature(0.3, -1.0, BOX))
    np.testing.assert_allclose(metrics["train/ent_coef"], 0.3)
    assert "train/ent_coef_loss" not in metrics
    assert policy.log_ent_coef.params == 0.0
    assert policy.actor.params[0] > 0.0, "and the policy climbs Q"
