"""From one score a text to a reward a token: the penalty for leaving the reference, its coefficient, and advantages within a group."""

from typing import Literal, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from thorndike.functional.policy_losses import weighted_mean
from thorndike.types import Number

Estimator: TypeAlias = Literal["k1", "k2", "k3"]
GroupScale: TypeAlias = Literal["group", "none"]


def kl_estimate(log_ratio: Float[Array, "*B"], estimator: Estimator) -> Float[Array, "*B"]:
    """Per-token estimate of KL(policy || reference) from tokens of the policy; ``log_ratio`` is ``log pi - log pi_ref``.

    Schulman 2020: ``k1`` is the ratio itself, unbiased and negative at times; ``k2`` half its square, whose *gradient* is that of the
    divergence; ``k3`` never negative and unbiased, but its gradient is that of the reversed divergence.
    """
    if estimator == "k1":
        return log_ratio
    if estimator == "k2":
        return 0.5 * jnp.square(log_ratio)
    return jnp.expm1(-log_ratio) + log_ratio


def penalized_rewards(
    score: Float[Array, " B"], log_ratio: Float[Array, "B T"], valid: Bool[Array, "B T"], coefficient: Number
) -> Float[Array, "B T"]:
    """``-coefficient * (log pi - log pi_ref)`` at every token, and the text's score at its last one. Ziegler et al. 2019, eq. 2.

    ``valid`` tokens stand at the front of a row. A row without any gets no reward.
    """
    lengths = jnp.sum(valid, axis=1, keepdims=True)
    last = valid & (jnp.arange(valid.shape[1])[None] == lengths - 1)
    return jnp.where(valid, -coefficient * log_ratio, 0.0) + jnp.where(last, score[:, None], 0.0)


def adapted_coefficient(
    coefficient: Float[Array, ""], kl: Float[Array, ""], target: Number, episodes: Number, horizon: Number, limit: Number = 0.2
) -> Float[Array, ""]:
    """A proportional controller in log space: up where the divergence (nats a text) is above the target, at most ``limit * n / horizon``.

    Ziegler et al. 2019 (arXiv:1909.08593), section 2.2.
    """
    error = jnp.clip(kl / target - 1.0, -limit, limit)
    return coefficient * (1.0 + error * episodes / horizon)


def whitened(x: Float[Array, "*B"], weight: Float[Array, "*B"], shift_mean: bool = True) -> Float[Array, "*B"]:
    """Unit variance over the entries of non-zero ``weight``, which others get 0 from; the mean is kept unless ``shift_mean``."""
    mean = weighted_mean(x, weight)
    scaled = (x - mean) / jnp.sqrt(weighted_mean(jnp.square(x - mean), weight) + 1e-8)
    return jnp.where(weight > 0, scaled if shift_mean else scaled + mean, 0.0)


def group_advantages(reward: Float[Array, "P G"], scale: GroupScale = "group") -> Float[Array, "P G"]:
    """Rewards minus the mean of their prompt's samples; ``group`` divides by their deviation too.

    Shao et al. 2024 (arXiv:2402.03300), section 4.1.2; ``none`` is Dr. GRPO (Liu et al. 2025, arXiv:2503.20783): the division weighs
    prompts that are nearly always or never solved more.
    """
    centred = reward - jnp.mean(reward, axis=1, keepdims=True)
    return centred if scale == "none" else centred / (jnp.std(reward, axis=1, keepdims=True, ddof=1) + 1e-4)


def leave_one_out_advantages(reward: Float[Array, "P G"]) -> Float[Array, "P G"]:
    """Rewards minus the mean of the *other* samples of their prompt (RLOO). Ahmadian et al. 2024 (arXiv:2402.14740), eq. 8."""
    group = reward.shape[1]
    return (reward - jnp.mean(reward, axis=1, keepdims=True)) * group / (group - 1)
