"""Memory for stacked frames that keeps each frame once: a stack of four is four frames in a row, and the next stack shares three of them.

What happened (``uniform.py``, ``prioritized.py``) stays as it is, but for its observations: in their place stands the number of the newest
frame, and the stacks are put together again when a minibatch is drawn. Frames are written in the order in which an environment showed
them: one a step, and the whole stack where an observation does not continue the last one (a new episode, however its engine fills the
stack; a pool that was started afresh). So every stack is exact, the true final observation of a time limit included.

There is room for a sixteenth more frames than steps. Where episodes last fewer than 64 steps on average, that is used up, and the oldest
steps, whose first frames are gone, are drawn with weight 0.
"""

from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt8

from thorndike.replay.prioritized import Draw
from thorndike.replay.replay import Replay, Ring
from thorndike.replay.uniform import Transitions
from thorndike.types import EnvSpec, Rollout

SPARE = 16
"""One frame more for so many steps."""


class FrameReplay(NamedTuple):
    """What happened, and the frames of it."""

    happened: PyTree
    """A memory of transitions whose observations are numbers of frames: ``b + B * (the frame's number in environment b)``."""
    frames: UInt8[Array, "slots H W C"]
    """Frame ``n`` of environment ``b`` lies in slot ``(n mod F) * B + b``."""
    written: Int[Array, " B"]
    """Frames of each environment so far."""
    last: UInt8[Array, "B H W K"]
    """The newest successor: an observation equal to it continues it."""


class Stacks(NamedTuple):
    """The form of the observations."""

    height: int
    width: int
    channels: int
    """Of one frame."""
    frames: int
    """In a stack."""


def stacks_of(spec: EnvSpec) -> Stacks | None:
    """The form of an environment's observations if they are stacks of frames ``uint8[H, W, frames * C]``; None if not."""
    space = spec.observation_space
    if spec.frames < 2 or not isinstance(space, gymnasium.spaces.Box) or space.dtype != np.uint8 or len(space.shape) != 3:
        return None
    height, width, depth = space.shape
    return None if depth % spec.frames else Stacks(height, width, depth // spec.frames, spec.frames)


def once_each(stacks: Stacks, ring: Ring, build: Callable[[Ring], Replay]) -> Replay:
    """The memory that ``build`` makes of a ring, for stacks of frames."""
    number = jax.ShapeDtypeStruct((), jnp.int32)
    inner = build(ring._replace(row={**ring.row, "obs": number, "next_obs": number}))
    kept = ring.steps + ring.steps // SPARE + 4 * (stacks.frames + 1)
    num_envs = ring.num_envs

    def init() -> FrameReplay:
        height, width, channels, frames = stacks
        return FrameReplay(
            inner.init(),
            jnp.zeros((kept * num_envs, height, width, channels), jnp.uint8),
            jnp.zeros((num_envs,), jnp.int32),
            jnp.zeros((num_envs, height, width, channels * frames), jnp.uint8),
        )

    def add(replay: FrameReplay, rollout: Rollout) -> FrameReplay:
        def one(carry: FrameReplay, row: tuple[Array, Array, Array]) -> tuple[FrameReplay, tuple[Array, Array]]:
            return _write(carry, stacks, kept, *row)

        step = rollout.step
        held, (now, after) = jax.lax.scan(one, replay._replace(happened=()), (rollout.obs, step.next_obs, step.valid))
        numbered = rollout._replace(obs=now, step=step._replace(next_obs=after))
        return held._replace(happened=inner.add(replay.happened, numbered))

    def sample(replay: FrameReplay, key: Key[Array, ""], beta: Float[Array, ""]) -> Draw:
        draw = inner.sample(replay.happened, key, beta)
        return draw._replace(batch=_with_stacks(draw.batch, replay, stacks, kept))

    def learnt(replay: FrameReplay, draw: Draw, errors: Float[Array, " M"]) -> FrameReplay:
        return replay._replace(happened=inner.learnt(replay.happened, draw, errors))

    inner_age = inner.age
    age = None if inner_age is None else lambda replay: inner_age(replay.happened)
    return Replay(init, add, sample, learnt, age)


def _write(
    replay: FrameReplay,
    stacks: Stacks,
    kept: int,
    obs: UInt8[Array, "B H W K"],
    next_obs: UInt8[Array, "B H W K"],
    valid: Bool[Array, " B"],
) -> tuple[FrameReplay, tuple[Int[Array, " B"], Int[Array, " B"]]]:
    """The frames of one step that are not there yet; the numbers of the newest frames of both observations."""
    num_envs, size = valid.shape[0], stacks.frames
    env = jnp.arange(num_envs, dtype=jnp.int32)
    begins = valid & jnp.any((obs != replay.last).reshape(num_envs, -1), axis=1)
    newest = replay.written + jnp.where(begins, size, 0) - 1
    after = newest + valid
    incoming = jnp.concatenate([_apart(obs, stacks), _apart(next_obs, stacks)[:, -1:]], axis=1)
    numbers = jnp.concatenate([newest[:, None] - jnp.arange(size - 1, -1, -1, dtype=jnp.int32)[None], after[:, None]], axis=1)
    wanted = jnp.concatenate([jnp.broadcast_to(begins[:, None], (num_envs, size)), valid[:, None]], axis=1)
    slots = jnp.where(wanted, (numbers % kept) * num_envs + env[:, None], kept * num_envs)
    frames = replay.frames.at[slots.ravel()].set(incoming.reshape(-1, *incoming.shape[2:]), mode="drop")
    last = jnp.where(valid[:, None, None, None], next_obs, replay.last)
    return FrameReplay((), frames, after + 1, last), (newest * num_envs + env, after * num_envs + env)


def _with_stacks(batch: PyTree, replay: FrameReplay, stacks: Stacks, kept: int) -> PyTree:
    """A minibatch with stacks in place of numbers; what lost its frames is no transition any more."""
    num_envs = replay.written.shape[0]
    oldest = batch.obs // num_envs - (stacks.frames - 1)
    there = oldest >= replay.written[batch.obs % num_envs] - kept

    def stacked(newest: Int[Array, "*M"]) -> UInt8[Array, "*M H W K"]:
        back = jnp.arange(stacks.frames - 1, -1, -1, dtype=jnp.int32) * num_envs
        slots = (newest[..., None] - back.reshape((1,) * newest.ndim + (-1,))) % (kept * num_envs)
        # Frames behind one another on the last axis, each with its own channels.
        found = jnp.moveaxis(replay.frames[slots], -4, -2)
        return found.reshape(*found.shape[:-2], -1)

    if isinstance(batch, Transitions):
        return batch._replace(obs=stacked(batch.obs), next_obs=stacked(batch.next_obs), weight=batch.weight * there)
    after = stacked(batch.step.next_obs)
    step = batch.step._replace(obs=after, next_obs=after, valid=batch.step.valid & there)
    return batch._replace(obs=stacked(batch.obs), step=step)


def _apart(stack: UInt8[Array, "B H W K"], stacks: Stacks) -> UInt8[Array, "B frames H W C"]:
    """A stack as its frames."""
    return jnp.moveaxis(stack.reshape(*stack.shape[:-1], stacks.frames, stacks.channels), -2, 1)
