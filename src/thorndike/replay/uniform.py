"""A ring of transitions ``[N, B]`` (N steps of B environments), sampled uniformly, with n-step returns formed when sampling."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.returns import n_step_return
from thorndike.types import Action, EnvSpec, Number, Observation, Rollout, Step


class ReplayBuffer(NamedTuple):
    """The ring. Rows ``[N, B]`` are stored flat, ``[N * B, ...]``, row ``t * B + b``."""

    rows: PyTree
    """obs, action, reward, next_obs, terminated, done, valid, the memory an action was chosen with, ensemble's mask, what a search found:
    ``[N * B, ...]``."""
    position: Int[Array, ""]
    """The step written next, in ``[0, N)``."""
    size: Int[Array, ""]
    """Steps stored, at most N."""


class Transitions(NamedTuple):
    """A sampled minibatch of (n-step) transitions ``[M, ...]``."""

    obs: Observation
    action: Action
    reward: Float[Array, " M"]
    """Discounted sum over the n steps."""
    next_obs: Observation
    discount: Float[Array, " M"]
    """What multiplies the bootstrap value: gamma^n, or 0 after a termination."""
    weight: Float[Array, " M"]
    """1, or 0 for a row that is no transition."""
    mask: PyTree = ()
    """Which members of an ensemble learn from it, where one stored that."""


def row_shapes(spec: EnvSpec, memory: PyTree = (), mask: PyTree = (), search: PyTree = ()) -> PyTree:
    """One stored transition of an environment, as shapes and dtypes; ``memory`` is a recurrent state of one environment ``[1, ...]``.

    ``mask`` is the shape of an ensemble's bootstrap mask, ``search`` that of what a search found, where there is one.
    """
    obs, action = (
        jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, jnp.asarray(x).dtype), space.sample())
        for space in (spec.observation_space, spec.action_space)
    )
    flag, number = jax.ShapeDtypeStruct((), jnp.bool_), jax.ShapeDtypeStruct((), jnp.float32)
    remembered = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), memory)
    row = {"obs": obs, "action": action, "reward": number, "next_obs": obs, "terminated": flag, "done": flag, "valid": flag}
    return row | {"memory": remembered, "mask": mask, "search": search}


def init_replay(row: PyTree, steps: int, num_envs: int) -> ReplayBuffer:
    """An empty ring for ``steps`` steps of ``num_envs`` environments, of transitions shaped as ``row`` (see ``row_shapes``)."""
    rows = jax.tree.map(lambda x: jnp.zeros((steps * num_envs, *x.shape), x.dtype), row)
    return ReplayBuffer(rows, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def rows_of(rollout: Rollout) -> PyTree:
    """The part of a rollout that replay keeps, ``[T, B, ...]``."""
    step, extras = rollout.step, rollout.extras if isinstance(rollout.extras, dict) else {}
    return {
        "obs": rollout.obs,
        "action": rollout.action,
        "reward": step.reward,
        "next_obs": step.next_obs,
        "terminated": step.terminated,
        "done": step.done,
        "valid": step.valid,
        "memory": extras.get("memory", ()),
        "mask": extras.get("mask", ()),
        "search": extras.get("search", ()),
    }


def add(buffer: ReplayBuffer, rollout: Rollout) -> ReplayBuffer:
    """Write ``T`` steps over the oldest ones. The number of steps in the ring must be a multiple of ``T``."""
    new = rows_of(rollout)
    length, num_envs = rollout.step.reward.shape
    steps = jax.tree.leaves(buffer.rows)[0].shape[0] // num_envs
    start = buffer.position * num_envs

    def write(stored: Array, incoming: Array) -> Array:
        flat = incoming.reshape((length * num_envs, *incoming.shape[2:]))
        return jax.lax.dynamic_update_slice_in_dim(stored, flat.astype(stored.dtype), start, axis=0)

    return ReplayBuffer(
        rows=jax.tree.map(write, buffer.rows, new),
        position=(buffer.position + length) % steps,
        size=jnp.minimum(buffer.size + length, steps),
    )


def sample(buffer: ReplayBuffer, key: Key[Array, ""], batch_size: int, num_envs: int, n_step: int, gamma: Number) -> Transitions:
    """Draw ``batch_size`` transitions uniformly with replacement. Consumes the key.

    The cost does not grow with the ring's size. With ``n_step > 1`` the newest ``n_step - 1`` steps are not drawn: what follows them is
    not stored yet.
    """
    return transitions_at(buffer, drawn_rows(buffer, key, batch_size, num_envs, n_step), num_envs, n_step, gamma)


def transitions_at(buffer: ReplayBuffer, index: Int[Array, " M"], num_envs: int, n_step: int, gamma: Number) -> Transitions:
    """The (n-step) transitions that begin at these rows, whose next ``n_step - 1`` steps must be stored."""
    total = jax.tree.leaves(buffer.rows)[0].shape[0]
    if n_step == 1:
        row = jax.tree.map(lambda x: x[index], buffer.rows)
        discount = jnp.where(row["terminated"], 0.0, gamma)
        return Transitions(
            row["obs"], row["action"], row["reward"], row["next_obs"], discount, row["valid"].astype(jnp.float32), row["mask"]
        )
    window = (index[None, :] + num_envs * jnp.arange(n_step, dtype=jnp.int32)[:, None]) % total
    reward, discount, last = n_step_return(
        buffer.rows["reward"][window], buffer.rows["terminated"][window], buffer.rows["done"][window], gamma
    )
    ending = (index + num_envs * last) % total
    first = {name: jax.tree.map(lambda x: x[index], buffer.rows[name]) for name in ("obs", "action", "valid", "mask")}
    next_obs = jax.tree.map(lambda x: x[ending], buffer.rows["next_obs"])
    return Transitions(first["obs"], first["action"], reward, next_obs, discount, first["valid"].astype(jnp.float32), first["mask"])


def sample_sequences(buffer: ReplayBuffer, key: Key[Array, ""], count: int, length: int, num_envs: int) -> Rollout:
    """Draw ``count`` sequences of ``length`` consecutive steps of one environment each, as a rollout ``[T, M, ...]``. Consumes the key.

    Its memory is the one its first action was chosen with, as stored (Kapturowski et al. 2019, "stored state").
    """
    total = jax.tree.leaves(buffer.rows)[0].shape[0]
    first = drawn_rows(buffer, key, count, num_envs, length)
    window = (first[None, :] + num_envs * jnp.arange(length, dtype=jnp.int32)[:, None]) % total
    row = jax.tree.map(lambda x: x[window], {name: rows for name, rows in buffer.rows.items() if name != "memory"})
    step = Step(
        obs=row["next_obs"],
        next_obs=row["next_obs"],
        reward=row["reward"],
        cost=jnp.zeros_like(row["reward"]),
        terminated=row["terminated"],
        truncated=row["done"] & ~row["terminated"],
        valid=row["valid"],
    )
    memory = jax.tree.map(lambda x: x[first], buffer.rows["memory"])
    return Rollout(row["obs"], row["action"], {}, step, memory)


def drawn_rows(buffer: ReplayBuffer, key: Key[Array, ""], count: int, num_envs: int, follow: int) -> Int[Array, " {count}"]:
    """Rows after which ``follow - 1`` more steps of their environment are stored."""
    total = jax.tree.leaves(buffer.rows)[0].shape[0]
    newest_allowed = jnp.maximum(buffer.size - (follow - 1), 1)
    oldest = buffer.position - buffer.size
    # A remainder of 32 random bits is biased by less than size / 2**32, and costs a third of randint's rejection-free draw.
    bits = jax.random.bits(key, (count,), jnp.uint32)
    drawn = (bits % (newest_allowed * num_envs).astype(jnp.uint32)).astype(jnp.int32)
    return (oldest * num_envs + drawn) % total
