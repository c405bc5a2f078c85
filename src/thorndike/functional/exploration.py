"""How an action is drawn from action values while learning: epsilon-greedy, by their exponentials, or by how little is known of them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from thorndike.types import Number

UNTRIED = 1e9
"""The optimistic value of an action that was never taken."""


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
    return Choice(action, is_greedy(q, action))


class Exploration(NamedTuple):
    """How a table is explored."""

    name: str
    """``epsilon``, ``boltzmann`` or ``ucb``."""
    ucb_coefficient: Number
    random_ties: bool


def explore(
    how: Exploration,
    q: Float[Array, "*batch actions"],
    strength: Float[Array, ""],
    visits: PyTree[Int[Array, "*batch actions"]],
    uniform: Float[Array, "*batch"],
) -> Choice:
    """An action by the rule of that name; ``strength`` is epsilon or the temperature, and only ``ucb`` looks at the visits."""
    if how.name == "boltzmann":
        return boltzmann(q, strength[None], uniform)
    if how.name == "ucb":
        return optimistic(q, visits, how.ucb_coefficient, uniform, random_ties=how.random_ties)
    return epsilon_greedy(q, strength, uniform, random_ties=how.random_ties)


def boltzmann(q: Float[Array, "*batch actions"], temperature: Float[Array, "#*batch"], uniform: Float[Array, "*batch"]) -> Choice:
    """Each action with probability proportional to ``exp(q / temperature)``: Sutton 1990; Sutton and Barto 2018, eq. 2.11.

    One number `uniform` in [0, 1) a row picks by the cumulative probabilities. A forbidden action, whose value is very low, is never drawn.
    """
    odds = jnp.exp((q - q.max(axis=-1, keepdims=True)) / jnp.expand_dims(temperature, -1))
    up_to = _lower_triangle(q.shape)
    reached = jnp.where(up_to, jnp.expand_dims(odds, -2), 0.0).sum(axis=-1)
    below = reached <= jnp.expand_dims(uniform, -1) * reached[..., -1:]
    action = jnp.minimum(below.sum(axis=-1, dtype=jnp.int32), q.shape[-1] - 1)
    return Choice(action, is_greedy(q, action))


def upper_confidence(
    q: Float[Array, "*batch actions"], visits: Int[Array, "*batch actions"], coefficient: Number
) -> Float[Array, "*batch actions"]:
    """``q + c sqrt(ln N(s) / N(s, a))``, and more than any value where an action has never been tried: Auer et al. 2002 (UCB1).

    Sutton and Barto 2018, eq. 2.10. The best of these values is the action to try.
    """
    total = jnp.maximum(visits.sum(axis=-1, keepdims=True), 1).astype(jnp.float32)
    bonus = coefficient * jnp.sqrt(jnp.log(total) / jnp.maximum(visits, 1).astype(jnp.float32))
    return jnp.where(visits == 0, UNTRIED, q + bonus)


def optimistic(
    q: Float[Array, "*batch actions"],
    visits: Int[Array, "*batch actions"],
    coefficient: Number,
    uniform: Float[Array, "*batch"],
    *,
    random_ties: bool = True,
) -> Choice:
    """The action of the best ``upper_confidence``; `uniform` breaks ties as in ``epsilon_greedy``."""
    tried = epsilon_greedy(upper_confidence(q, visits, coefficient), jnp.zeros_like(uniform), uniform, random_ties=random_ties)
    return tried._replace(greedy=is_greedy(q, tried.action))


def is_greedy(q: Float[Array, "*batch actions"], action: Int[Array, "*batch"]) -> Bool[Array, "*batch"]:
    """Whether an action has the highest value."""
    chosen = lax.broadcasted_iota(jnp.int32, q.shape, q.ndim - 1) == jnp.expand_dims(action, -1)
    return (chosen & (q >= q.max(axis=-1, keepdims=True))).any(axis=-1)


def _lower_triangle(shape: tuple[int, ...]) -> Bool[Array, "*batch n n"]:
    """For rows ``[..., n]``: whether the last index is at most the one before it."""
    square = (*shape, shape[-1])
    return lax.broadcasted_iota(jnp.int32, square, len(shape)) <= lax.broadcasted_iota(jnp.int32, square, len(shape) - 1)


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
    return (jnp.expand_dims(mask, -2) & _lower_triangle(mask.shape)).sum(axis=-1, dtype=jnp.int32)
