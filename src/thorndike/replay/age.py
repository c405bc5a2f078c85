"""How old what a memory replays is, and the random numbers by which a memory is looked into while training knows nothing of it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from thorndike.replay.uniform import ReplayBuffer


def mean_age(buffer: ReplayBuffer, num_envs: int, weight: Float[Array, " leaves"] | None = None) -> Float[Array, ""]:
    """How many environment steps ago the transitions that are drawn were stored, on average; the newest step counts 0.

    ``weight`` is in proportion to the probability of each row ``[N * B]`` (more entries than rows are not looked at); without it all
    stored ones are equally probable. 0 for an empty memory.
    """
    if weight is None:
        return num_envs * (jnp.maximum(buffer.size, 1) - 1).astype(jnp.float32) / 2.0
    rows = jax.tree.leaves(buffer.rows)[0].shape[0]
    steps = rows // num_envs
    by_step = jnp.sum(weight[:rows].reshape(steps, num_envs), axis=1)
    ages = (buffer.position - 1 - jnp.arange(steps, dtype=jnp.int32)) % steps
    return num_envs * jnp.sum(by_step * ages) / jnp.maximum(jnp.sum(by_step), 1e-30)


def key_to_look_by(env_steps: Int[Array, ""]) -> Key[Array, ""]:
    """A key that follows from the steps made alone: looking takes nothing from the random numbers of training, and repeats itself."""
    return jax.random.fold_in(jax.random.key(0), env_steps)
