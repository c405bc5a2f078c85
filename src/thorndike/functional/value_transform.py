"""Values of any size as probabilities of a few atoms: squeezed by a root, then shared between two neighbours.

Pohlen et al. 2018, "Observe and look further" (arXiv:1805.11593), proposition A.2; Schrittwieser et al. 2020, MuZero (arXiv:1911.08265),
appendix F.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.functional.distributional import two_hot

EPSILON = 1e-3
"""The slope of ``h`` far out, which gives it an inverse that is Lipschitz continuous."""


def signed_root(x: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """``h(x) = sign(x) (sqrt(|x| + 1) - 1) + epsilon x``."""
    return jnp.sign(x) * (jnp.sqrt(jnp.abs(x) + 1.0) - 1.0) + EPSILON * x


def signed_square(y: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """The inverse of ``signed_root``."""
    beyond = jnp.abs(y) + 1.0 + EPSILON
    # (sqrt(1 + 4 e b) - 1) / (2 e), without the difference of two numbers that are nearly equal.
    root = 2.0 * beyond / (jnp.sqrt(1.0 + 4.0 * EPSILON * beyond) + 1.0)
    return jnp.sign(y) * (jnp.square(root) - 1.0)


class Scale(NamedTuple):
    """How ``atoms`` logits say a number between ``-limit`` and ``limit``."""

    limit: float
    atoms: int

    @property
    def support(self) -> Float[Array, " atoms"]:
        """The squeezed number that each atom stands for."""
        end = signed_root(jnp.float32(self.limit))
        return jnp.linspace(-end, end, self.atoms)

    def number(self, logits: Float[Array, "*B atoms"]) -> Float[Array, "*B"]:
        """What logits say."""
        return signed_square(jax.nn.softmax(logits, axis=-1) @ self.support)

    def probabilities(self, x: Float[Array, "*B"]) -> Float[Array, "*B atoms"]:
        """What logits should say: numbers beyond the limit are those at it."""
        return two_hot(signed_root(x), self.support)
