"""The loss of deep Q-learning, from what two networks say of a minibatch: any form of return, double, Munchausen."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from thorndike.functional.distributional import Errors, ReturnDistribution
from thorndike.functional.munchausen import log_policy_reward, soft_bonus, soft_policy
from thorndike.types import Number


class Said(NamedTuple):
    """What the network that learns and the target network say of ``M`` transitions. Q-values are those of allowed actions."""

    outputs: Float[Array, "M A K"]
    """Of the learning network at the observation."""
    fractions: Float[Array, "M K"]
    """The quantile levels that these are at."""
    q_next: Float[Array, "M A"]
    """Of the learning network at the successor."""
    target_q: Float[Array, "M A"]
    """Of the target network at the observation."""
    target_outputs_next: Float[Array, "M A K"]
    """Of the target network at the successor."""
    target_q_next: Float[Array, "M A"]


class Happened(NamedTuple):
    """What came of the actions."""

    action: Int[Array, " M"]
    reward: Float[Array, " M"]
    discount: Float[Array, " M"]
    """What multiplies the value of the successor: 0 after a termination."""


class Munchausen(NamedTuple):
    """See ``munchausen.py``."""

    alpha: Number
    temperature: Number
    lowest: Number


class Rule(NamedTuple):
    """Which target is learnt."""

    distribution: ReturnDistribution
    double: bool
    munchausen: Munchausen | None


def value_errors(said: Said, happened: Happened, rule: Rule) -> tuple[Errors, Float[Array, " M"]]:
    """The errors of the chosen actions, and their expected returns.

    With an expected value: Mnih et al. 2015, eq. 2; ``double``: van Hasselt et al. 2016, eq. 4, where the learning network chooses the
    action that the target network values; ``munchausen``: Vieillard et al. 2020, eq. 1.
    """
    taken = jax.nn.one_hot(happened.action, said.outputs.shape[1]) > 0
    chosen = jnp.sum(jnp.where(taken[..., None], said.outputs, 0.0), axis=1)
    policy, reward = _policy_and_reward(said, happened, rule)
    following = rule.distribution.mix(said.target_outputs_next, policy)
    errors = rule.distribution.errors(chosen, said.fractions, following, reward, happened.discount)
    return errors, rule.distribution.mean(chosen[:, None, :])[:, 0]


def _policy_and_reward(said: Said, happened: Happened, rule: Rule) -> tuple[Float[Array, "M A"], Float[Array, " M"]]:
    """The policy that goes on from the successor, and the reward it is owed until then."""
    if rule.munchausen is None:
        best = jnp.argmax(said.q_next if rule.double else said.target_q_next, axis=-1)
        return jax.nn.one_hot(best, said.target_q_next.shape[-1]), happened.reward
    alpha, temperature, lowest = rule.munchausen
    later = happened.discount * soft_bonus(said.target_q_next, temperature)
    now = log_policy_reward(said.target_q, happened.action, alpha, temperature, lowest)
    return soft_policy(said.target_q_next, temperature), happened.reward + now + later
