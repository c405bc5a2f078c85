"""What the maximum-entropy learners (SAC, TQC, CrossQ, REDQ) share: the policy's step and the temperature's.

Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications" (arXiv:1812.05905), equations 7 and 18.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from thorndike.functional.descent import Optimized, descend, optimized
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.squashed_gaussian import sample_squashed
from thorndike.types import Metrics, Number, Observation


class SoftPolicy(NamedTuple):
    """A policy and the temperature alpha that weighs its entropy against reward."""

    actor: Optimized
    log_ent_coef: Optimized
    """log alpha; it stays as it is where alpha is given."""


class Temperature(NamedTuple):
    """How alpha is had."""

    given: Number | None
    """Alpha, or None where it is learnt."""
    target_entropy: Number
    """The entropy that a learnt alpha aims at, in nats."""

    def of(self, policy: SoftPolicy) -> Float[Array, ""]:
        """Alpha at present."""
        return jnp.exp(policy.log_ent_coef.params) if self.given is None else jnp.asarray(self.given, jnp.float32)


def temperature(ent_coef: Number | str, target_entropy: Number | str, space: gymnasium.Space) -> Temperature:
    """From the settings: ``"auto"`` learns alpha, and aims at an entropy of minus the number of action dimensions."""
    aim = -float(math.prod(space.shape or ())) if isinstance(target_entropy, str) else target_entropy
    return Temperature(None if isinstance(ent_coef, str) else ent_coef, aim)


def soft_policy(params: Float[Array, " P"], ent_coef: Number, optimizer: optax.GradientTransformation) -> SoftPolicy:
    """A policy before its first step, and the temperature it starts with."""
    return SoftPolicy(optimized(params, optimizer), optimized(jnp.log(jnp.asarray(ent_coef, jnp.float32)), optimizer))


def policy_loss(
    params: Float[Array, " P"],
    apply: Callable[[Float[Array, " P"], Observation], Float[Array, "M D2"]],
    q_of: Callable[[Observation, Float[Array, "M D"]], Float[Array, " M"]],
    ent_coef: Float[Array, ""],
    obs: Observation,
    noise: Float[Array, "M D"],
    weight: Float[Array, " M"],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """``E[alpha log pi(a|s) - Q(s, a)]`` and the mean log-probability: Haarnoja et al., eq. 7."""
    action, log_prob = sample_squashed(apply(params, obs), noise)
    loss = weighted_mean(ent_coef * log_prob - q_of(obs, action), weight)
    return loss, weighted_mean(log_prob, weight)


def temperature_loss(log_ent_coef: Float[Array, ""], log_prob: Float[Array, ""], target_entropy: Number) -> Float[Array, ""]:
    """``-log alpha (log pi + target entropy)``: Stable-Baselines3's form of Haarnoja et al., eq. 18."""
    return -log_ent_coef * jax.lax.stop_gradient(log_prob + target_entropy)


def improve_policy(
    policy: SoftPolicy,
    apply: Callable[[Float[Array, " P"], Observation], Float[Array, "M D2"]],
    q_of: Callable[[Observation, Float[Array, "M D"]], Float[Array, " M"]],
    obs: Observation,
    noise: Float[Array, "M D"],
    weight: Float[Array, " M"],
    heat: Temperature,
    optimizer: optax.GradientTransformation,
    rate: Float[Array, ""],
) -> tuple[SoftPolicy, Metrics]:
    """One step of the policy up ``q_of`` plus its entropy, and one of the temperature if it is learnt."""
    alpha = heat.of(policy)
    (loss, log_prob), gradient = jax.value_and_grad(policy_loss, has_aux=True)(policy.actor.params, apply, q_of, alpha, obs, noise, weight)
    actor, norm = descend(optimizer, rate, policy.actor, gradient)
    metrics = {"train/actor_loss": loss, "train/actor_grad_norm": norm, "train/entropy": -log_prob, "train/ent_coef": alpha}
    if heat.given is not None:
        return SoftPolicy(actor, policy.log_ent_coef), metrics
    heat_loss, slope = jax.value_and_grad(temperature_loss)(policy.log_ent_coef.params, log_prob, heat.target_entropy)
    metrics["train/ent_coef_loss"] = heat_loss
    return SoftPolicy(actor, descend(optimizer, rate, policy.log_ent_coef, slope)[0]), metrics
