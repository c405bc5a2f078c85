"""Generalised state-dependent exploration (gSDE): noise that is a function of the state, and that function held for several steps.

Raffin, Kober, Stulp 2020, "Smooth Exploration for Robotic Reinforcement Learning" (arXiv:2005.05719). The noise of an action is
``features(s) @ (deviations * E)`` with ``E`` a matrix ``[H, D]`` of standard normal numbers that stays for ``sde_sample_freq`` steps: the
same state meets the same noise. Over all matrices an action is Gaussian (paper, eq. 5), which is what is learnt from.

One deviation: a constant is among the features. Without it there is no noise where all others are 0, as in a new network that sees zeros,
and the density of an action without noise has gradients without bounds.

The held matrix is part of the learner's memory: it is saved with a run, and begins anew with an episode.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.types import Algorithm, Metrics, Observation, Rollout

SMALLEST_VARIANCE = 1e-6
"""Added to a state's variance, against rounding where deviations have shrunk."""


def noise_features(width: int) -> int:
    """How many features H the noise depends on, of a last hidden layer of this width."""
    return width + 1


def with_constant(features: Float[Array, "*B W"]) -> Float[Array, "*B H"]:
    """The features, and a 1."""
    return jnp.concatenate([features, jnp.ones_like(features[..., :1])], axis=-1)


class HeldNoise(NamedTuple):
    """The noise of one step."""

    held: Float[Array, "B H D"]
    """Drawn at this step or an earlier one."""
    fresh: Float[Array, "B H D"]
    """Drawn at this step."""


class Memory(NamedTuple):
    """What is carried from one step to the next."""

    inner: PyTree
    """The memory of the learner itself."""
    held: PyTree
    age: Int[Array, " B"]
    """Steps since the episode began, or since memory did."""


def state_dependent_parameters(
    mean: Float[Array, "*B D"], features: Float[Array, "*B H"], log_std: Float[Array, "H D"]
) -> Float[Array, "*B P"]:
    """Mean, log standard deviation over all matrices ``E``, and what ``E`` is multiplied with: ``[*B, D + D + H D]``.

    The last part is used in acting alone; where only the density is asked for, the compiler never makes it.
    """
    deviations = jnp.exp(log_std)
    variance = jnp.square(features) @ jnp.square(deviations) + SMALLEST_VARIANCE
    spread = features[..., :, None] * jnp.broadcast_to(deviations, (*features.shape, deviations.shape[-1]))
    return jnp.concatenate([mean, 0.5 * jnp.log(variance), spread.reshape((*mean.shape[:-1], -1))], axis=-1)


def state_dependent_sample(parameters: Float[Array, "*B P"], noise: Float[Array, "*B H D"]) -> Float[Array, "*B D"]:
    """Mean plus the noise of this state: the action, before any squashing."""
    dimensions = noise.shape[-1]
    spread = parameters[..., 2 * dimensions :].reshape(noise.shape)
    return parameters[..., :dimensions] + jnp.sum(spread * noise, axis=-2)


def with_held_noise(algorithm: Algorithm, sde_sample_freq: int) -> Algorithm:
    """The same learner, whose ``act`` takes ``HeldNoise``, with its noise held for ``sde_sample_freq`` steps; -1: for a rollout's length.

    New noise is drawn at the beginning of an episode too. Raises ``UserError`` for 0 steps.
    """
    if sde_sample_freq == 0:
        raise UserError("sde_sample_freq is at least 1, or -1 for one draw a rollout; got 0")
    every = sde_sample_freq if sde_sample_freq > 0 else algorithm.needs.rollout_length
    drawn = jax.eval_shape(lambda key: algorithm.draw(key, 1), jax.random.key(0))

    def memory(batch: int) -> Memory:
        held = jax.tree.map(lambda x: jnp.zeros((batch, *x.shape[2:]), x.dtype), drawn)
        return Memory(algorithm.memory(batch), held, jnp.zeros((batch,), jnp.int32))

    def act(actor: PyTree, memory: Memory, obs: Observation, noise: PyTree) -> tuple[Memory, PyTree, PyTree]:
        due = memory.age % every == 0
        held = jax.tree.map(lambda new, old: jnp.where(due.reshape(due.shape + (1,) * (new.ndim - 1)), new, old), noise, memory.held)
        inner, action, extras = algorithm.act(actor, memory.inner, obs, HeldNoise(held, noise))
        return Memory(inner, held, memory.age + 1), action, extras

    def greedy(actor: PyTree, memory: Memory, obs: Observation, noise: PyTree) -> tuple[Memory, PyTree, PyTree]:
        inner, action, extras = algorithm.greedy(actor, memory.inner, obs, noise)
        return memory._replace(inner=inner), action, extras

    def update(state: PyTree, rollout: Rollout, key: Key[Array, ""]) -> tuple[PyTree, Metrics]:
        return algorithm.update(state, rollout._replace(memory=rollout.memory.inner), key)

    def observe(state: PyTree, rollout: Rollout, key: Key[Array, ""]) -> tuple[PyTree, Metrics]:
        return algorithm.observe(state, rollout._replace(memory=rollout.memory.inner), key)

    return algorithm._replace(memory=memory, act=act, greedy=greedy, update=update, observe=observe)
