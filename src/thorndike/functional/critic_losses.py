"""What ensembles of critics are fitted to, and how far they are off. Critics lead: ``[K, M, outputs]``."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.functional.distributional import midpoints, quantile_huber
from thorndike.functional.policy_losses import weighted_mean


def lowest(values: Float[Array, "K M 1"]) -> Float[Array, "M 1"]:
    """The most pessimistic critic of each row (Fujimoto et al. 2018, arXiv:1802.09477, eq. 10)."""
    return jnp.min(values, axis=0)


def lowest_atoms(values: Float[Array, "K M N"], drop: int) -> Float[Array, "M kept"]:
    """All critics' quantiles of each row in order, less the ``drop`` highest (Kuznetsov et al. 2020, arXiv:2005.04269, eq. 12)."""
    critics, rows, quantiles = values.shape
    pooled = jnp.moveaxis(values, 0, 1).reshape((rows, critics * quantiles))
    # The lowest by top_k, which is twice as fast as a sort on a CPU.
    return -jax.lax.top_k(-pooled, critics * quantiles - drop)[0]


def squared_errors(values: Float[Array, "K M 1"], target: Float[Array, "M 1"], weight: Float[Array, " M"]) -> Float[Array, ""]:
    """Half the mean squared error of every critic, summed over the critics."""
    each = jax.vmap(weighted_mean, (0, None))(0.5 * jnp.square(values[..., 0] - target[None, :, 0]), weight)
    return jnp.sum(each)


def quantile_errors(values: Float[Array, "K M N"], target: Float[Array, "M L"], weight: Float[Array, " M"]) -> Float[Array, ""]:
    """The Huber quantile loss of every critic, a mean over its quantiles, summed over the critics (Kuznetsov et al. 2020, eq. 14)."""
    count = values.shape[-1]
    fractions = jnp.broadcast_to(midpoints(count)[None], values.shape[1:])
    each = jax.vmap(quantile_huber, (0, None, None, None))(values, fractions, target, 1.0)
    return jnp.sum(jax.vmap(weighted_mean, (0, None))(each, weight)) / count


def chosen_critics(params: Float[Array, "K P"], ranks: Float[Array, " R"], number: int) -> Float[Array, "{number} P"]:
    """The critics of the highest ``ranks``, so drawn without replacement; all of them as they are."""
    return params if number == params.shape[0] else params[jax.lax.top_k(ranks, number)[1]]
