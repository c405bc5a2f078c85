"""A dataset as a source: each iteration draws minibatches from recorded steps, and no environment is stepped."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from thorndike.environments.host.steps import host_step
from thorndike.training.datasets import Dataset
from thorndike.training.sources import from_environment
from thorndike.types import Algorithm, EnvSpec, EpisodeStats, Rollout, Source

ENGINE = "dataset"


def dataset_spec(data: Dataset) -> EnvSpec:
    """The facts of the environment a dataset is of, as a learner of it sees them."""
    origin = data.origin
    return EnvSpec(origin.environment, origin.observation_space, origin.action_space, 1, origin.max_episode_steps, ENGINE)


def whole_dataset(data: Dataset) -> Rollout:
    """All steps in order, as a rollout ``[N, ...]`` in the learner's units."""
    step = host_step(
        data.next_obs,
        data.next_obs,
        reward=data.reward,
        cost=np.zeros_like(data.reward),
        terminated=data.terminated,
        truncated=data.truncated,
        valid=np.ones(len(data.reward), np.bool_),
    )
    return Rollout(data.obs, from_environment(data.origin.action_space, data.action), {}, step, ())


def dataset_source(data: Dataset, algorithm: Algorithm) -> Source:
    """Minibatches drawn uniformly with replacement: rollouts ``[rollout_length, batch_size]``, whose rows are one minibatch each.

    One of the runner's steps is one minibatch. The steps of the dataset are held once, for all seeds together.
    """
    rows = jax.tree.map(jnp.asarray, whole_dataset(data))
    total, length, batch = len(data.reward), algorithm.needs.rollout_length, algorithm.needs.batch_size

    def draw(key: Key[Array, ""], iterations: int) -> Int[Array, "I T M"]:
        # A remainder of 32 random bits is biased by less than N / 2**32.
        bits = jax.random.bits(key, (iterations, length, batch), jnp.uint32)
        return (bits % np.uint32(total)).astype(jnp.int32)

    def collect(state: PyTree, actor: PyTree, noise: Int[Array, "T M"]) -> tuple[PyTree, Rollout, EpisodeStats]:
        nothing = jnp.zeros((), jnp.float32)
        drawn = jax.tree.map(lambda x: x[noise], rows)
        return state, drawn, EpisodeStats(nothing, nothing, nothing, jnp.full((), length, jnp.float32))

    return Source(lambda key: (), draw, collect, lambda state: (), dataset_spec(data), compiled=True)
