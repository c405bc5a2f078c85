"""Policy-gradient losses and the estimators reported beside them. All are means over a minibatch, weighted by ``weight``."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thorndike.types import Metrics, Number


def weighted_mean(x: Float[Array, "*B"], weight: Float[Array, "*B"]) -> Float[Array, ""]:
    """Mean of ``x`` over the rows of non-zero ``weight``; 0 if there is none."""
    return jnp.sum(x * weight) / jnp.maximum(jnp.sum(weight), 1e-8)


def actor_critic_loss(
    log_prob: Float[Array, "*B"],
    entropy: Float[Array, "*B"],
    value: Float[Array, "*B"],
    advantage: Float[Array, "*B"],
    target: Float[Array, "*B"],
    weight: Float[Array, "*B"],
    vf_coef: Number,
    ent_coef: Number,
) -> tuple[Float[Array, ""], Metrics]:
    """The loss of an advantage actor-critic, and its terms. Mnih et al. 2016 (arXiv:1602.01783), section 4.

    The caller has stopped the gradients of advantages and targets.
    """
    policy = -weighted_mean(log_prob * advantage, weight)
    critic = weighted_mean(jnp.square(value - target), weight)
    mean_entropy = weighted_mean(entropy, weight)
    loss = policy + vf_coef * critic - ent_coef * mean_entropy
    return loss, {"train/loss": loss, "train/policy_loss": policy, "train/value_loss": critic, "train/entropy_loss": -mean_entropy}


def clipped_surrogate(
    log_ratio: Float[Array, "*B"], advantage: Float[Array, "*B"], clip_range: Number, weight: Float[Array, "*B"]
) -> Float[Array, ""]:
    """PPO's pessimistic surrogate, as a loss. Schulman et al. 2017 (arXiv:1707.06347), eq. 7.

    ``log_ratio`` is the log-probability under the new policy minus that under the one that acted.
    """
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_range, 1.0 + clip_range)
    return -weighted_mean(jnp.minimum(ratio * advantage, clipped * advantage), weight)


def value_loss(
    value: Float[Array, "*B"],
    old_value: Float[Array, "*B"],
    target: Float[Array, "*B"],
    clip_range_vf: Number | None,
    weight: Float[Array, "*B"],
) -> Float[Array, ""]:
    """Squared error of the value, with PPO2's clipping around the old value if ``clip_range_vf`` is given."""
    if clip_range_vf is None:
        return weighted_mean(jnp.square(value - target), weight)
    clipped = old_value + jnp.clip(value - old_value, -clip_range_vf, clip_range_vf)
    return weighted_mean(jnp.maximum(jnp.square(value - target), jnp.square(clipped - target)), weight)


def approximate_kl(log_ratio: Float[Array, "*B"], weight: Float[Array, "*B"]) -> Float[Array, ""]:
    """Non-negative, unbiased estimate of KL(old || new) from actions of the old policy: ``r - 1 - log r``. Schulman 2020 ("k3")."""
    return weighted_mean(jnp.expm1(log_ratio) - log_ratio, weight)


def clip_fraction(log_ratio: Float[Array, "*B"], clip_range: Number, weight: Float[Array, "*B"]) -> Float[Array, ""]:
    """Share of rows whose probability ratio left ``[1 - clip_range, 1 + clip_range]``."""
    outside = jnp.abs(jnp.expm1(log_ratio)) > clip_range
    return weighted_mean(outside.astype(log_ratio.dtype), weight)


def explained_variance(prediction: Float[Array, "*B"], target: Float[Array, "*B"], valid: Bool[Array, "*B"]) -> Float[Array, ""]:
    """``1 - Var(target - prediction) / Var(target)`` over valid rows: 1 is perfect, 0 no better than the mean."""
    weight = valid.astype(target.dtype)

    def variance(x: Float[Array, "*B"]) -> Float[Array, ""]:
        return weighted_mean(jnp.square(x - weighted_mean(x, weight)), weight)

    return 1.0 - variance(target - prediction) / jnp.maximum(variance(target), 1e-8)


def standardize(x: Float[Array, "*B"], weight: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """Zero mean and unit variance over the rows of non-zero ``weight``."""
    centred = x - weighted_mean(x, weight)
    return centred / (jnp.sqrt(weighted_mean(jnp.square(centred), weight)) + 1e-8)
