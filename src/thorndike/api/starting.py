"""What a run begins with: fresh networks, or those of an offline run with its dataset in the replay; and a learnt reward, if it has one."""

from collections.abc import Callable
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from thorndike.api.building import Job, Request, build_job, recorded_data
from thorndike.api.learned_rewards import recorded_reward, with_reward
from thorndike.api.recorded_run import Objects, request_in
from thorndike.environments import registry
from thorndike.errors import UserError
from thorndike.records import read_record
from thorndike.replay.off_policy import State
from thorndike.replay.uniform import ReplayBuffer, add
from thorndike.training.checkpoints import load_checkpoint
from thorndike.training.dataset_source import whole_dataset
from thorndike.training.segment import Carry


def offline_request(run: Path, algorithm: str, environment: str) -> Request:
    """The request of an offline run that another may start from.

    Raises ``UserError`` unless it is a run of the same algorithm on a dataset of the same environment.
    """
    request = request_in(read_record(run), run, Objects())
    if request.dataset is None or request.algorithm != algorithm:
        raise UserError(f"{run} is no run of {algorithm} on a dataset; make one: thorndike train {algorithm} DATASET")
    if request.environment != environment:
        raise UserError(f"{run} learnt from a dataset of {request.environment}, not of {environment}: start from one of {environment}")
    return request


def first_carry(job: Job) -> Carry:
    """The carry of a run's first iteration."""
    carry = job.runner.init()
    if job.request.reward is not None:
        carry = with_reward(carry, job, recorded_reward(job.request.reward))
    if job.request.start_from is None:
        return carry
    run = Path(job.request.start_from)
    request = offline_request(run, job.request.algorithm, job.request.environment)
    before = build_job(request, registry.resolve(request.environment, env_kwargs=request.env_kwargs), None, None)
    learnt = load_checkpoint(run, before.runner, before.source)[0].learner.learnt
    fresh = carry.learner
    if not isinstance(fresh, State):
        raise UserError(f"{request.algorithm} has no replay to fill from a dataset: train it without --start-from")
    wanted, found = jax.tree.map(jnp.shape, fresh.learnt), jax.tree.map(jnp.shape, learnt)
    if jax.tree.map(lambda shape: shape[1:], wanted, is_leaf=_is_shape) != jax.tree.map(lambda shape: shape[1:], found, is_leaf=_is_shape):
        raise UserError(f"{run} has networks of another size: train with its settings of net_arch and activation")
    taken = jax.tree.map(lambda x: _of_each_seed(x, job.request.seeds), learnt)
    filled = _filler(job, request)
    return carry._replace(learner=fresh._replace(learnt=taken, replay=filled(fresh.replay)))


def _filler(job: Job, request: Request) -> Callable[[PyTree], PyTree]:
    """Replays ``[S, ...]`` -> the same with the dataset's newest steps in them, as one environment after another."""
    rows = whole_dataset(recorded_data(cast(dict[str, str], request.dataset)))
    envs = job.request.num_envs

    def fill(replay: ReplayBuffer) -> ReplayBuffer:
        room = jax.tree.leaves(replay.rows)[0].shape[1] // envs
        length = job.algorithm.needs.rollout_length
        steps = min(room, len(rows.step.reward) // envs) // length * length
        # Single transitions are what is drawn, so which environment's ring a step lies in is all one.
        shaped = jax.tree.map(lambda x: jnp.asarray(x[: steps * envs].reshape((steps, envs, *np.shape(x)[1:]))), rows)
        return jax.jit(jax.vmap(lambda one: add(one, shaped)))(replay)

    return fill


def _of_each_seed(x: jax.Array, seeds: int) -> jax.Array:
    """Agent ``i`` goes on with agent ``i`` of the run before, beginning again where there are more of them."""
    return jnp.array(x[jnp.arange(seeds) % x.shape[0]])


def _is_shape(x: object) -> bool:
    return isinstance(x, tuple) and all(isinstance(size, int) for size in x)
