"""Running mean and variance, merged in parallel, and what is divided by them.

Chan, Golub and LeVeque 1979, "Updating formulae and a pairwise algorithm for computing sample variances": two groups of rows merge exactly
from their counts, means and variances, so that a rollout, a batch of environments or a single row are all added in the same way.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

AnyArray: TypeAlias = Array | np.ndarray
"""Rows come from compiled and from host engines."""


class Moments(NamedTuple):
    """How many rows were ``seen``, their mean and their (population) variance. An empty one has ``seen`` 0, mean 0 and variance 1."""

    seen: Float[Array, "*batch"]
    mean: Float[Array, "*batch_and_shape"]
    variance: Float[Array, "*batch_and_shape"]


def empty_moments(shape: tuple[int, ...], batch: tuple[int, ...] = ()) -> Moments:
    """No rows yet: ``seen`` ``[*batch]``, mean 0 and variance 1 ``[*batch, *shape]``, so that normalising by it changes nothing."""
    return Moments(jnp.zeros(batch, jnp.float32), jnp.zeros((*batch, *shape), jnp.float32), jnp.ones((*batch, *shape), jnp.float32))


def moments_of(rows: Float[AnyArray, "..."], valid: Bool[AnyArray, "*leading"]) -> Moments:
    """Moments of ``rows`` ``[*leading, *shape]`` over all leading axes, counting only the rows where ``valid``. Two passes."""
    axes = tuple(range(valid.ndim))
    weight = _per_row(valid, rows.ndim).astype(jnp.float32)
    count = jnp.sum(valid, dtype=jnp.float32)
    mean = jnp.sum(rows * weight, axes) / jnp.maximum(count, 1.0)
    squares = jnp.sum(jnp.square(rows - _for_rows(mean, rows.ndim)) * weight, axes)
    return Moments(count, mean, jnp.where(count > 0, squares / jnp.maximum(count, 1.0), 1.0))


def merge_moments(first: Moments, second: Moments) -> Moments:
    """Moments of both groups together (Chan et al. 1979, eq. 2.1, in weights instead of sums: no overflow). Shapes as ``first``."""
    count = first.seen + second.seen
    share = _per_row(second.seen / jnp.maximum(count, 1.0), first.mean.ndim)
    distance = second.mean - first.mean
    variance = first.variance * (1.0 - share) + second.variance * share + jnp.square(distance) * share * (1.0 - share)
    return Moments(count, first.mean + distance * share, variance)


def add_row(moments: Moments, row: Float[AnyArray, "*batch_and_shape"], valid: Bool[AnyArray, "*batch"]) -> Moments:
    """Each of a batch of moments with one more row of its own, where ``valid``: a group of one has variance 0 (Welford 1962)."""
    return merge_moments(moments, Moments(jnp.asarray(valid, jnp.float32), jnp.asarray(row), jnp.zeros_like(row)))


def pool_moments(moments: Moments) -> Moments:
    """A batch of moments ``[B, ...]`` (``seen`` ``[B]``) as one."""
    count = jnp.sum(moments.seen)
    share = _per_row(moments.seen / jnp.maximum(count, 1.0), moments.mean.ndim)
    mean = jnp.sum(share * moments.mean, axis=0)
    variance = jnp.sum(share * (moments.variance + jnp.square(moments.mean - mean[None])), axis=0)
    return Moments(count, mean, jnp.where(count > 0, variance, 1.0))


def normalize(rows: Float[AnyArray, "..."], moments: Moments, epsilon: float = 1e-8, clip: float = 10.0) -> Float[Array, "..."]:
    """``(rows - mean) / sqrt(variance + epsilon)``, clipped to ``[-clip, clip]`` (Stable-Baselines3's VecNormalize)."""
    deviation = jnp.sqrt(moments.variance + epsilon)
    return jnp.clip((rows - _for_rows(moments.mean, rows.ndim)) / _for_rows(deviation, rows.ndim), -clip, clip)


def scale(rows: Float[AnyArray, "..."], moments: Moments, epsilon: float = 1e-8, clip: float = 10.0) -> Float[Array, "..."]:
    """``rows / sqrt(variance + epsilon)``, clipped: the sign stays, so it suits rewards."""
    return jnp.clip(rows / _for_rows(jnp.sqrt(moments.variance + epsilon), rows.ndim), -clip, clip)


def running_returns(
    reward: Float[AnyArray, "T *B"], done: Bool[AnyArray, "T *B"], before: Float[AnyArray, "*B"], gamma: float
) -> tuple[Float[Array, "*B"], Float[Array, "T *B"]]:
    """The discounted sum of the rewards so far, ``R <- gamma R + r``, restarted after ``done``: its last value and that of each step.

    What VecNormalize divides rewards by the deviation of (Engstrom et al. 2020, arXiv:2005.12729, section 3). ``before`` is the sum so far.
    """

    def forward(so_far: Float[Array, "*B"], row: tuple[Array, Array]) -> tuple[Array, Array]:
        reward_t, done_t = row
        current = gamma * so_far + reward_t
        return jnp.where(done_t, 0.0, current), current

    return jax.lax.scan(forward, jnp.asarray(before), (jnp.asarray(reward), jnp.asarray(done)))


def _per_row(weight: AnyArray, ndim: int) -> AnyArray:
    """``weight`` with unit axes behind, to multiply arrays of ``ndim`` axes."""
    return weight.reshape(weight.shape + (1,) * (ndim - weight.ndim))


def _for_rows(shared: Array, ndim: int) -> Array:
    """``shared`` with unit axes in front, so that it meets rows of ``ndim`` axes without implicit rank promotion."""
    return shared.reshape((1,) * (ndim - shared.ndim) + shared.shape)
