"""Distributions of returns: how a network's numbers describe one, and how they are taught by what follows.

Four forms, all ``ReturnDistribution``: a plain expected value; probabilities of fixed atoms (C51: Bellemare et al. 2017, arXiv:1707.06887);
values at fixed quantiles (QR-DQN: Dabney et al. 2018, arXiv:1710.10044); values at any quantile asked for (IQN: Dabney et al. 2018,
arXiv:1806.06923). ``M`` is a minibatch, ``A`` actions, ``K`` the numbers that describe one action's return.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from thorndike.types import Number


class Errors(NamedTuple):
    """How far a prediction is from its target, a row of a minibatch."""

    loss: Float[Array, " M"]
    """What is minimised."""
    surprise: Float[Array, " M"]
    """What replay is prioritised by; no gradient should flow through it."""


class ReturnDistribution(NamedTuple):
    """How ``outputs`` numbers describe the return of an action."""

    outputs: int
    """K."""
    mean: Callable[[Float[Array, "*B A K"]], Float[Array, "*B A"]]
    """Outputs -> expected returns Q."""
    mix: Callable[[Float[Array, "M A K"], Float[Array, "M A"]], Float[Array, "M K"]]
    """Outputs, probabilities of the actions -> the return of a policy that draws them so, as ``errors`` takes it."""
    fractions: Callable[[Key[Array, ""], int], Float[Array, "M K"]]
    """key, M -> the quantile levels that the outputs are asked for at (zeros where there are none). Consumes the key."""
    errors: Callable[
        [Float[Array, "M K"], Float[Array, "M K"], Float[Array, "M K"], Float[Array, " M"], Float[Array, " M"]],
        Errors,
    ]
    """The chosen action's outputs, the fractions they were asked for at, ``mix`` of what follows, reward, discount -> errors."""


def expected_value() -> ReturnDistribution:
    """One number an action, its expected return; the Huber loss of Mnih et al. 2015."""

    def errors(predicted: Array, fractions: Array, following: Array, reward: Array, discount: Array) -> Errors:
        del fractions
        error = predicted[:, 0] - jax.lax.stop_gradient(reward + discount * following[:, 0])
        return Errors(huber(error, 1.0), jnp.abs(error))

    return ReturnDistribution(1, lambda outputs: outputs[..., 0], _mix_numbers, _no_fractions(1), errors)


def categorical(v_min: Number, v_max: Number, atoms: int) -> ReturnDistribution:
    """C51: logits of ``atoms`` returns evenly spaced from ``v_min`` to ``v_max``. Bellemare et al. 2017, algorithm 1.

    The loss is the cross-entropy, which is also the priority (Hessel et al. 2018, arXiv:1710.02298, section 4).
    """
    support = jnp.linspace(v_min, v_max, atoms)

    def mix(outputs: Array, weights: Array) -> Array:
        return _mix_numbers(jax.nn.softmax(outputs, axis=-1), weights)

    def errors(predicted: Array, fractions: Array, following: Array, reward: Array, discount: Array) -> Errors:
        del fractions
        target = jax.lax.stop_gradient(categorical_projection(following, reward, discount, support))
        loss = -jnp.sum(target * jax.nn.log_softmax(predicted, axis=-1), axis=-1)
        return Errors(loss, loss)

    return ReturnDistribution(atoms, lambda outputs: jax.nn.softmax(outputs, axis=-1) @ support, mix, _no_fractions(atoms), errors)


def quantiles(count: int, kappa: float = 1.0) -> ReturnDistribution:
    """QR: the returns at ``count`` evenly spaced quantiles, with the Huber quantile loss. Dabney et al. 2018, algorithm 1."""

    def fixed(key: Key[Array, ""], rows: int) -> Float[Array, "M K"]:
        del key
        return jnp.broadcast_to(midpoints(count)[None], (rows, count))

    return _by_quantiles(count, kappa, fixed)


def implicit_quantiles(count: int, kappa: float = 1.0) -> ReturnDistribution:
    """IQN: the returns at ``count`` quantile levels drawn uniformly, which the network takes as its input. Dabney et al. 2018, eq. 3."""
    return _by_quantiles(count, kappa, lambda key, rows: jax.random.uniform(key, (rows, count)))


def _by_quantiles(count: int, kappa: float, fractions: Callable[[Key[Array, ""], int], Array]) -> ReturnDistribution:
    def errors(predicted: Array, fractions: Array, following: Array, reward: Array, discount: Array) -> Errors:
        target = jax.lax.stop_gradient(reward[:, None] + discount[:, None] * following)
        loss = quantile_huber(predicted, fractions, target, kappa)
        return Errors(loss, loss)

    return ReturnDistribution(count, lambda outputs: jnp.mean(outputs, axis=-1), _mix_numbers, fractions, errors)


def _mix_numbers(outputs: Float[Array, "M A K"], weights: Float[Array, "M A"]) -> Float[Array, "M K"]:
    return jnp.sum(weights[..., None] * outputs, axis=-2)


def _no_fractions(count: int) -> Callable[[Key[Array, ""], int], Array]:
    return lambda key, rows: jnp.zeros((rows, count))


def midpoints(count: int) -> Float[Array, " count"]:
    """The quantile levels ``(i + 1/2) / count``, whose values give the least Wasserstein error. Dabney et al. 2018 (QR), lemma 2."""
    return (jnp.arange(count, dtype=jnp.float32) + 0.5) / count


def huber(error: Float[Array, "*B"], kappa: float) -> Float[Array, "*B"]:
    """``error^2 / 2`` within ``kappa`` of 0, ``kappa (|error| - kappa / 2)`` beyond. Huber 1964."""
    size = jnp.abs(error)
    within = jnp.minimum(size, kappa)
    return 0.5 * within**2 + kappa * (size - within)


def quantile_huber(
    predicted: Float[Array, "M N"], fractions: Float[Array, "M N"], target: Float[Array, "M L"], kappa: float
) -> Float[Array, " M"]:
    """Quantile regression smoothed near 0: the sum over predicted quantiles of the mean over target samples.

    Dabney et al. 2018 (QR-DQN), eq. 10, divided by ``kappa`` as in IQN, eq. 2. ``target`` gets no gradient here; the caller stops it.
    """
    error = target[:, None, :] - predicted[:, :, None]
    side = jnp.abs(fractions[:, :, None] - (error < 0.0).astype(error.dtype))
    return jnp.sum(jnp.mean(side * huber(error, kappa) / kappa, axis=2), axis=1)


def categorical_projection(
    probabilities: Float[Array, "M K"], reward: Float[Array, " M"], discount: Float[Array, " M"], support: Float[Array, " K"]
) -> Float[Array, "M K"]:
    """The distribution of ``reward + discount * Z`` put back on the atoms of ``Z``: Bellemare et al. 2017, eq. 7.

    Each moved atom gives its probability to its two neighbours by nearness: the sum over atoms of a triangle around each, which has no
    scatter in it.
    """
    moved = reward[:, None] + discount[:, None] * support[None, :]
    nearness = jnp.swapaxes(two_hot(moved, support), 1, 2)
    return jnp.sum(nearness * probabilities[:, None, :], axis=-1)


def two_hot(x: Float[Array, "*B"], support: Float[Array, " K"]) -> Float[Array, "*B K"]:
    """A number as probabilities of the two atoms next to it, by nearness; beyond the ends it is the atom there.

    ``support`` is evenly spaced.
    """
    low, high, count = support[0], support[-1], support.shape[0]
    place = (jnp.clip(x, low, high) - low) / (high - low) * (count - 1)
    atoms = jnp.arange(count, dtype=jnp.float32).reshape((1,) * x.ndim + (count,))
    return jnp.clip(1.0 - jnp.abs(place[..., None] - atoms), 0.0, 1.0)


class Support(NamedTuple):
    """The atoms of C51."""

    v_min: Number
    v_max: Number
    atoms: int


DISTRIBUTIONS = ("none", "c51", "quantile", "implicit")
"""The choices of a ``distribution`` setting."""


def return_distribution(name: str, support: Support, count: int) -> ReturnDistribution:
    """The one of this name, with ``support`` (c51) or ``count`` quantiles."""
    if name == "c51":
        return categorical(*support)
    if name == "quantile":
        return quantiles(count)
    return implicit_quantiles(count) if name == "implicit" else expected_value()
