"""A trained policy: its actor, the wrappers' statistics, and the spaces it maps between. It is loaded from files that hold no code."""

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from thorndike.errors import UserError
from thorndike.training.sources import to_environment
from thorndike.types import Algorithm, EnvSpec, Observation, Shared, Step, Wrapper


class Policy:
    """A policy to act with, evaluate and watch. With several seeds it acts as the best one; ``policy.seeds[i]`` is any other."""

    def __init__(
        self,
        algorithm: Algorithm,
        wrapper: Wrapper,
        spec: EnvSpec,
        actors: PyTree,
        statistics: PyTree,
        best: int,
        run: Path | None = None,
        first: int = 0,
    ) -> None:
        """``actors`` and ``statistics`` lead with the seed axis ``[S]``; ``best`` is the seed used by default,
        ``first`` the number of the first one in its run."""
        self.algorithm = algorithm
        self.wrapper = wrapper
        self.spec = spec
        self.actors = actors
        self.statistics = statistics
        self.best = best
        self.run = run
        self.first = first
        self._draws = 0

    @property
    def number_of_seeds(self) -> int:
        """How many agents were trained side by side."""
        return jax.tree.leaves(self.actors)[0].shape[0]

    @cached_property
    def seeds(self) -> Sequence["Policy"]:
        """Each agent as a policy of its own."""
        return [self._only(i) for i in range(self.number_of_seeds)]

    def _only(self, seed: int) -> "Policy":
        actors, statistics = jax.tree.map(lambda x: x[seed : seed + 1], (self.actors, self.statistics))
        return Policy(self.algorithm, self.wrapper, self.spec, actors, statistics, 0, self.run, self.first + seed)

    def predict(
        self, obs: Observation, memory: PyTree = None, deterministic: bool = True, action_mask: np.ndarray | None = None
    ) -> tuple[np.ndarray, PyTree]:
        """Action for one observation, or for a batch of them, and the memory to pass with the next ones.

        ``memory=None`` starts an episode. ``action_mask`` is what the environment gave beside ``obs``, where it gives masks. Raises
        ``UserError`` if the observation does not fit the policy's space.
        """
        batch, single = self._as_batch(obs if action_mask is None else _with_mask(obs, action_mask))
        actor, statistics = self._agent
        if memory is None:
            size = jax.tree.leaves(batch)[0].shape[0]
            wrapper_memory, seen = self.wrapper.init(statistics, batch)
            inner = self.algorithm.memory(size)
            previous = batch
        else:
            inner, wrapper_memory, previous = memory
            wrapper_memory, seen = self._see(statistics, wrapper_memory, previous, batch)
        self._draws += 1
        noise = self.noise(jax.random.fold_in(jax.random.key(0), self._draws), jax.tree.leaves(batch)[0].shape[0])
        inner, action = self._decide[deterministic](actor, inner, seen, noise)
        chosen = _from_start(self.spec.action_space, np.asarray(action))
        return chosen[0] if single else chosen, (inner, wrapper_memory, batch)

    def value(self, obs: Observation) -> np.ndarray:
        """The learner's estimate of the value of one observation, or of each in a batch."""
        batch, single = self._as_batch(obs)
        actor, statistics = self._agent
        _, seen = self.wrapper.init(statistics, batch)
        value = np.asarray(self._value(actor, seen))
        return value[0] if single else value

    @cached_property
    def _agent(self) -> tuple[PyTree, PyTree]:
        return jax.tree.map(lambda x: x[self.best], (self.actors, self.statistics))

    @cached_property
    def _decide(self) -> dict[bool, Callable]:
        def decide(choose: Callable, actor: PyTree, memory: PyTree, seen: Observation, noise: PyTree) -> tuple[PyTree, Array]:
            memory, action, _ = choose(actor, memory, seen, noise)
            return memory, to_environment(self.spec.action_space, action)

        return {True: jax.jit(partial(decide, self.algorithm.greedy)), False: jax.jit(partial(decide, self.algorithm.act))}

    @cached_property
    def _value(self) -> Callable:
        return jax.jit(self.algorithm.value)

    def noise(self, key: Key[Array, ""], size: int) -> PyTree:
        """Noise ``[size, ...]`` of one decision.

        The algorithm draws for its own number of environments, so several draws of one step are joined, each from a key of its own: what
        it draws for successive steps may be correlated. So noise that is coloured in training is white here.
        """
        draws = -(-size // self.spec.num_envs)
        drawn = jax.vmap(lambda key: self.algorithm.draw(key, 1))(jax.random.split(key, draws))

        def join(rows: Array | Shared) -> Array | Shared:
            if isinstance(rows, Shared):
                return Shared(rows.numbers[0, 0])
            return rows.reshape((-1, *rows.shape[3:]))[:size]

        return jax.tree.map(join, drawn, is_leaf=lambda x: isinstance(x, Shared))

    def _see(self, statistics: PyTree, memory: PyTree, previous: Observation, obs: Observation) -> tuple[PyTree, Observation]:
        size = jax.tree.leaves(obs)[0].shape[0]
        zeros, no = jnp.zeros((size,), jnp.float32), jnp.zeros((size,), bool)
        step = Step(obs, obs, zeros, zeros, no, no, ~no)
        memory, step = self.wrapper.step(statistics, memory, previous, jnp.zeros((size,), jnp.int32), step)
        return memory, step.obs

    def _as_batch(self, obs: Observation) -> tuple[Observation, bool]:
        space = self.spec.observation_space
        single = _batch_axes(space, obs) == 0
        cast = _cast(space, obs)
        return (jax.tree.map(lambda x: x[None], cast) if single else cast), single


def _from_start(space: gymnasium.Space, action: np.ndarray) -> np.ndarray:
    """Learners count whole-number actions from 0; within the library the engines add the space's start, here there is none."""
    if isinstance(space, gymnasium.spaces.Discrete | gymnasium.spaces.MultiDiscrete):
        return action + np.asarray(space.start, action.dtype)
    return action


def _with_mask(obs: Observation, mask: np.ndarray) -> Observation:
    return {**(obs if isinstance(obs, dict) else {"observation": obs}), "action_mask": mask}


def _batch_axes(space: gymnasium.Space, obs: Observation) -> int:
    """0 for one observation, 1 for a batch. Raises ``UserError`` for anything else."""
    if isinstance(space, gymnasium.spaces.Dict):
        _require(isinstance(obs, dict) and set(obs) == set(space.spaces), space, obs)
        return _same_axes(space, obs, {_batch_axes(part, obs[name]) for name, part in space.spaces.items()})
    if isinstance(space, gymnasium.spaces.Tuple):
        _require(isinstance(obs, tuple | list) and len(obs) == len(space.spaces), space, obs)
        return _same_axes(space, obs, {_batch_axes(part, obs[i]) for i, part in enumerate(space.spaces)})
    shape = space.shape or ()
    axes = np.ndim(obs) - len(shape)
    _require(axes in (0, 1) and np.shape(obs)[axes:] == shape, space, obs)
    return axes


def _same_axes(space: gymnasium.Space, obs: Observation, axes: set[int]) -> int:
    _require(len(axes) <= 1, space, obs)
    return max(axes, default=0)


def _require(holds: bool, space: gymnasium.Space, obs: Observation) -> None:
    if not holds:
        came = jax.tree.map(np.shape, obs)
        raise UserError(f"this policy takes one observation of {space}, or a batch of them with one leading axis; got shape {came}")


def _cast(space: gymnasium.Space, obs: Observation) -> Observation:
    if isinstance(space, gymnasium.spaces.Dict):
        return {name: _cast(part, obs[name]) for name, part in space.spaces.items()}
    if isinstance(space, gymnasium.spaces.Tuple):
        return tuple(_cast(part, obs[i]) for i, part in enumerate(space.spaces))
    array = np.asarray(obs)
    if np.issubdtype(space.dtype, np.floating):
        return array.astype(np.float32)
    return array if space.dtype == np.uint8 else array.astype(np.int32)
