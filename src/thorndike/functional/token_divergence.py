"""How far a language model has moved from a reference, token by token: Schulman's estimators from samples of the model ("Approximating KL
divergence", 2020). The exact value over the vocabulary is ``policy_divergence.categorical_divergence``.

``log_probs`` are the model's of tokens that it drew itself, ``reference`` the other's of the same tokens.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def k1(log_probs: Float[Array, "*B"], reference: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """``log p - log q``: unbiased, and often negative."""
    return log_probs - reference


def k2(log_probs: Float[Array, "*B"], reference: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """``(log p - log q)^2 / 2``: a little biased; its gradient is that of the divergence."""
    return 0.5 * jnp.square(log_probs - reference)


def k3(log_probs: Float[Array, "*B"], reference: Float[Array, "*B"]) -> Float[Array, "*B"]:
    """``q / p - 1 - log(q / p)``: unbiased and never negative; as a loss its gradient is that of the *reverse* divergence."""
    ratio = reference - log_probs
    return jnp.expm1(ratio) - ratio


def weighted_text_mean(values: Float[Array, "*B T"], weights: Float[Array, "*B T"]) -> Float[Array, ""]:
    """The mean over all tokens that count, long and short texts alike; 0 where none does."""
    return jnp.sum(values * weights) / jnp.maximum(jnp.sum(weights), 1e-9)
