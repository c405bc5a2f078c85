"""What learning from a fixed dataset adds to temporal-difference learning: expectiles, advantage weights, conservatism."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.functional.policy_losses import weighted_mean
from thorndike.types import Number


def expectile_loss(error: Float[Array, " M"], expectile: Number, weight: Float[Array, " M"]) -> Float[Array, ""]:
    """``E[|tau - 1(u < 0)| u^2]`` of ``u = target - prediction`` (Kostrikov et al. 2021, arXiv:2110.06169, eq. 5).

    With ``expectile`` 0.5 the best prediction is the targets' mean; towards 1 it is their maximum.
    """
    side = jnp.where(error < 0.0, 1.0 - expectile, expectile)
    return weighted_mean(side * jnp.square(error), weight)


def advantage_weights(advantage: Float[Array, " M"], temperature: Number, most: Number) -> Float[Array, " M"]:
    """``exp(A / temperature)``, at most ``most``, with no gradient (Peng et al. 2019, arXiv:1910.00177; Nair et al. 2020, eq. 13)."""
    return jax.lax.stop_gradient(jnp.minimum(jnp.exp(advantage / temperature), most))


def conservative_gap(q: Float[Array, "K M A"], taken: Float[Array, "K M"], weight: Float[Array, " M"]) -> Float[Array, ""]:
    """How far Q of any action lies above that of the dataset's: ``E[log sum_a exp Q(s, a) - Q(s, a_data)]``, summed over critics.

    Kumar et al. 2020 (arXiv:2006.04779), eq. 4: CQL(H). Of a Box ``q`` are samples with ``log density + log number`` taken off.
    """
    above = jax.nn.logsumexp(q, axis=-1) - taken
    return jnp.sum(jax.vmap(weighted_mean, (0, None))(above, weight))


def cloning_scale(q: Float[Array, " M"], alpha: Number, weight: Float[Array, " M"]) -> Float[Array, ""]:
    """``alpha / E|Q|``, with no gradient: what Q weighs beside a squared error (Fujimoto and Gu 2021, arXiv:2106.06860, eq. 5)."""
    return jax.lax.stop_gradient(alpha / jnp.maximum(weighted_mean(jnp.abs(q), weight), 1e-6))
