"""How an action is drawn from action values while learning: epsilon-greedy, with ties broken at random or by the lowest index."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


class Choice(NamedTuple):
    """Actions and what is known of how they came about."""

    action: Int[Array, "*batch"]
    greedy: Bool[Array, "*batch"]
    """Whether the action has the highest value, be it by choice or by chance."""


def epsilon_greedy(
    q: Float[Array, "*batch actions"],
    epsilon: Float[Array, "#*batch"],
    uniform: Float[Array, "*batch"],
    *,
    random_ties: bool = True,
    allowed: Bool[Array, "*batch actions"] | None = None,
) -> Choice:
    """A random action with probability `epsilon`, else one of the highest value. `allowed`, if given, bounds the random ones.

    One number `uniform` in [0, 1) a row decides everything: below epsilon it explores, and its position inside its part, itself uniform,
    picks among the candidates. A float32 has 2**23 such numbers, so that with epsilon 0.01 and 10 actions the chance of each is exact to
    about 1 part in 10,000. Ties go to a random one of the best actions, or to the first if not `random_ties`.
    """
    explores = uniform < epsilon
    low, width = jnp.where(explores, 0.0, epsilon), jnp.where(explores, epsilon, 1.0 - epsilon)
    position = (uniform - low) / jnp.where(width > 0.0, width, 1.0)
    best = q >= q.max(axis=-1, keepdims=True)
    at_random = jnp.expand_dims(explores, -1) if allowed is None else jnp.expand_dims(explores, -1) & allowed
    candidates = at_random | best
    rank = _running_count(candidates)
    draw = jnp.floor(position * rank[..., -1]).astype(jnp.int32)
    # Rounding may carry a position just below 1 up to the count itself.
    draw = jnp.minimum(draw, rank[..., -1] - 1)
    if not random_ties:
        draw = jnp.where(explores, draw, 0)
    action = (rank <= jnp.expand_dims(draw, -1)).sum(axis=-1, dtype=jnp.int32)
    chosen = lax.broadcasted_iota(jnp.int32, q.shape, q.ndim - 1) == jnp.expand_dims(action, -1)
    return Choice(action, (chosen & best).any(axis=-1))


def epsilon_greedy_probabilities(
    q: Float[Array, "*batch actions"], epsilon: Float[Array, ""], allowed: Bool[Array, "*batch actions"] | None = None
) -> Float[Array, "*batch actions"]:
    """What ``epsilon_greedy`` without random ties chooses each action with."""
    first = jax.nn.one_hot(q.argmax(axis=-1), q.shape[-1])
    at_random = jnp.ones(q.shape, q.dtype) if allowed is None else (allowed | (q >= q.max(axis=-1, keepdims=True))).astype(q.dtype)
    return epsilon * at_random / at_random.sum(axis=-1, keepdims=True) + (1.0 - epsilon) * first


def _running_count(mask: Bool[Array, "*batch n"]) -> Int[Array, "*batch n"]:
    """Cumulative count along the last axis."""
    # jnp.cumsum would become a reduce-window, which does not fuse; the triangle costs n squared bit operations, and n is small.
    n = mask.shape[-1]
    square = (*mask.shape, n)
    triangle = lax.broadcasted_iota(jnp.int32, square, mask.ndim) <= lax.broadcasted_iota(jnp.int32, square, mask.ndim - 1)
    return (jnp.expand_dims(mask, -2) & triangle).sum(axis=-1, dtype=jnp.int32)
