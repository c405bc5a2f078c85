"""What an off-policy learner asks of a memory, and the three that there are: uniform, prioritised, and of whole sequences."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from thorndike.networks.hidden_layers import ROWS
from thorndike.networks.network import as_rows
from thorndike.replay.age import mean_age
from thorndike.replay.prioritized import Draw, add_prioritized, init_prioritized, sample_prioritized, update_priorities
from thorndike.replay.uniform import ReplayBuffer, add, init_replay, sample, sample_sequences
from thorndike.types import Number, Observation, Rollout


class Ring(NamedTuple):
    """The size of a memory."""

    row: PyTree
    """One transition, as shapes and dtypes: see ``row_shapes``."""
    steps: int
    num_envs: int


class Replay(NamedTuple):
    """A memory as pure functions."""

    init: Callable[[], PyTree]
    add: Callable[[PyTree, Rollout], PyTree]
    sample: Callable[[PyTree, Key[Array, ""], Float[Array, ""]], Draw]
    """memory, key, how far importance weights undo priorities (beta) -> minibatch. Consumes the key."""
    learnt: Callable[[PyTree, Draw, Float[Array, " M"]], PyTree]
    """memory, a minibatch, its errors -> memory."""
    age: Callable[[PyTree], Float[Array, ""]] | None = None
    """memory -> how many environment steps ago what is drawn was stored, on average."""


def uniform_replay(ring: Ring, batch_size: int, n_step: int, gamma: Number) -> Replay:
    """All transitions equally often."""

    def draw(buffer: ReplayBuffer, key: Key[Array, ""], beta: Float[Array, ""]) -> Draw:
        del beta
        return _unweighted(sample(buffer, key, batch_size, ring.num_envs, n_step, gamma), batch_size)

    return Replay(partial(init_replay, *ring), add, draw, _as_it_is, partial(mean_age, num_envs=ring.num_envs))


def sequence_replay(ring: Ring, count: int, length: int) -> Replay:
    """``count`` sequences of ``length`` steps, all equally often."""

    def draw(buffer: ReplayBuffer, key: Key[Array, ""], beta: Float[Array, ""]) -> Draw:
        del beta
        return _unweighted(sample_sequences(buffer, key, count, length, ring.num_envs), length * count)

    return Replay(partial(init_replay, *ring), add, draw, _as_it_is, partial(mean_age, num_envs=ring.num_envs))


def prioritized_replay(ring: Ring, batch_size: int, n_step: int, gamma: Number, alpha: Number) -> Replay:
    """Transitions in proportion to ``|error|^alpha``."""
    return Replay(
        init=partial(init_prioritized, *ring),
        add=partial(add_prioritized, n_step=n_step),
        sample=lambda replay, key, beta: sample_prioritized(replay, key, batch_size, ring.num_envs, n_step, gamma, beta),
        learnt=lambda replay, draw, errors: update_priorities(replay, draw.rows, errors, alpha),
        age=lambda replay: mean_age(replay.ring, ring.num_envs, replay.levels[0]),
    )


def replayed_observations(replay: Replay, memory: PyTree, key: Key[Array, ""], batch_size: int) -> Observation:
    """``ROWS`` observations or a few more, ``[N, ...]``, of as many minibatches as it takes. Consumes the key."""
    keys = jax.random.split(key, -(-ROWS // batch_size))

    def one(key: Key[Array, ""]) -> Observation:
        batch = replay.sample(memory, key, jnp.ones(())).batch
        return as_rows(batch.obs) if isinstance(batch, Rollout) else batch.obs

    return as_rows(jax.vmap(one)(keys))


def _unweighted(batch: PyTree, rows: int) -> Draw:
    return Draw(batch, jnp.zeros((0,), jnp.int32), jnp.ones((rows,), jnp.float32))


def _as_it_is(replay: ReplayBuffer, draw: Draw, errors: Float[Array, " M"]) -> ReplayBuffer:
    del draw, errors
    return replay
