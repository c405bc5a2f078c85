"""Acting step by step from Python, for host rollouts and evaluation: compiled moves over ``[S, B]``, seeds by environments."""

from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from thorndike.training.sources import to_environment, where_done
from thorndike.types import Action, Algorithm, Noise, Observation, Step, Wrapper


class Decision(NamedTuple):
    """One decision for all seeds and environments, ``[S, B, ...]``."""

    memory: PyTree
    action: Action
    engine_action: Action
    """The same in the environment's units."""
    extras: PyTree


class Acting(NamedTuple):
    """The compiled moves. Every argument but a time index leads with ``[S]``."""

    decide: Callable[[PyTree, PyTree, Observation, Noise, np.int32], Decision]
    """actors, memory, seen obs, noise ``[S, T, B, ...]``, t -> Decision."""
    first_sight: Callable[[PyTree, Observation], tuple[PyTree, Observation]]
    """statistics, obs -> wrapper memory, seen obs."""
    see: Callable[[PyTree, PyTree, Observation, Action, Step], tuple[PyTree, Step]]
    """statistics, wrapper memory, obs acted on, engine action, raw step -> wrapper memory, step as the learner sees it."""
    forget: Callable[[Array | np.ndarray, PyTree], PyTree]
    """done, memory -> memory, started afresh where an episode ended."""
    fresh_memory: Callable[[], PyTree]


def acting(algorithm: Algorithm, wrapper: Wrapper, space: gymnasium.Space, seeds: int, num_envs: int, greedy: bool = False) -> Acting:
    """Compile the moves of ``seeds`` agents in ``num_envs`` environments each; ``space`` is the environment's action space."""
    choose = algorithm.greedy if greedy else algorithm.act

    def decide(actor: PyTree, memory: PyTree, seen: Observation, noise: Noise, t: Array) -> Decision:
        memory, action, extras = choose(actor, memory, seen, jax.tree.map(lambda x: x[t], noise))
        return Decision(memory, action, to_environment(space, action), extras)

    def forget(done: Array, memory: PyTree) -> PyTree:
        return where_done(done, algorithm.memory(num_envs), memory)

    def fresh_memory() -> PyTree:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *x.shape)), algorithm.memory(num_envs))

    # Without wrappers the step goes through as it is: no compiled call, no copy.
    see = jax.jit(jax.vmap(wrapper.step)) if wrapper.name else _as_it_is
    forget_all = jax.jit(jax.vmap(forget)) if jax.tree.leaves(algorithm.memory(num_envs)) else _nothing_to_forget
    return Acting(jax.jit(jax.vmap(decide, in_axes=(0, 0, 0, 0, None))), jax.jit(jax.vmap(wrapper.init)), see, forget_all, fresh_memory)


def _as_it_is(statistics: PyTree, memory: PyTree, obs: Observation, action: Action, step: Step) -> tuple[PyTree, Step]:
    del statistics, obs, action
    return memory, step


def _nothing_to_forget(done: Array | np.ndarray, memory: PyTree) -> PyTree:
    del done
    return memory
