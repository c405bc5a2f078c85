"""Who is recorded: a trained policy as it acts while it learns, or actions at random."""

from typing import NamedTuple, Protocol

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, PyTree

from thorndike.errors import UserError
from thorndike.networks.masking import MASK
from thorndike.training.acting import acting
from thorndike.training.policy import Policy
from thorndike.types import Observation, Step

_ACTING = 0x434C4950
"""Separates the random numbers of recording from those of training and evaluation."""


class Performer(Protocol):
    """Acts in a batch of environments; everything leads with ``[1, B]``."""

    def begin(self, obs: Observation) -> None:
        """Every environment begins an episode."""
        ...

    def act(self) -> np.ndarray:
        """One action each, in the environment's units."""
        ...

    def see(self, step: Step) -> None:
        """What came of it."""
        ...


class AtRandom:
    """Uniform actions, among the allowed ones where there is a mask; of an unbounded Box, standard normal ones."""

    def __init__(self, space: gymnasium.Space, num_envs: int, seeds: tuple[int, int]) -> None:
        """``seeds``: the run's, and the collection's number."""
        self._space, self._num_envs, self._dice = space, num_envs, np.random.default_rng([*seeds, _ACTING])
        self._obs: Observation = ()

    def begin(self, obs: Observation) -> None:
        """Every environment begins an episode."""
        self._obs = obs

    def act(self) -> np.ndarray:
        """One action each."""
        mask = self._obs.get(MASK) if isinstance(self._obs, dict) else None
        return np.stack([self._one(None if mask is None else np.asarray(mask)[0, row]) for row in range(self._num_envs)])[None]

    def see(self, step: Step) -> None:
        """What came of it."""
        self._obs = step.obs

    def _one(self, mask: np.ndarray | None) -> np.ndarray:
        space, dice = self._space, self._dice
        match space:
            case spaces.Box():
                bounded = np.isfinite(space.low) & np.isfinite(space.high)
                low, high = np.where(bounded, space.low, -1.0), np.where(bounded, space.high, 1.0)
                return np.where(bounded, dice.uniform(low, high), dice.normal(size=space.shape)).astype(np.float32)
            case spaces.Discrete():
                return np.array(dice.integers(space.n) if mask is None or not mask.any() else dice.choice(np.flatnonzero(mask)), np.int32)
            case spaces.MultiDiscrete() | spaces.MultiBinary() if mask is None:
                most = space.nvec if isinstance(space, spaces.MultiDiscrete) else np.full(space.shape, 2)
                return dice.integers(most).astype(np.int32)
        raise UserError(f"actions of {space}, with masks or without, cannot be drawn at random here: record a trained run instead")


class _Held(NamedTuple):
    """What a policy carries from one step to the next."""

    obs: Observation
    seen: Observation
    memory: PyTree
    wrapper_memory: PyTree


class Agent:
    """A trained policy, its best seed, acting as it did while it learnt."""

    def __init__(self, policy: Policy, num_envs: int, seeds: tuple[int, int]) -> None:
        """``seeds``: the run's, and the collection's number."""
        self._moves = acting(policy.algorithm, policy.wrapper, policy.spec.action_space, 1, num_envs)
        self._actor, self._statistics = jax.tree.map(lambda x: x[policy.best : policy.best + 1], (policy.actors, policy.statistics))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seeds[0]), _ACTING), seeds[1])

        def noise(t: Array) -> PyTree:
            return jax.tree.map(lambda x: x[None, None], policy.noise(jax.random.fold_in(key, t), num_envs))

        self._noise, self._t = jax.jit(noise), 0
        self._held = _Held((), (), (), ())
        self._action: PyTree = ()
        self._later: PyTree = ()

    def begin(self, obs: Observation) -> None:
        """Every environment begins an episode."""
        wrapper_memory, seen = self._moves.first_sight(self._statistics, obs)
        self._held = _Held(obs, seen, self._moves.fresh_memory(), wrapper_memory)

    def act(self) -> np.ndarray:
        """One action each."""
        decision = self._moves.decide(self._actor, self._held.memory, self._held.seen, self._noise(np.int32(self._t)), np.int32(0))
        self._t, self._action, self._later = self._t + 1, decision.engine_action, decision.memory
        return np.asarray(decision.engine_action)

    def see(self, step: Step) -> None:
        """What came of it."""
        held = self._held
        wrapper_memory, shown = self._moves.see(self._statistics, held.wrapper_memory, held.obs, self._action, step)
        memory = self._moves.forget(np.asarray(shown.done) | ~np.asarray(shown.valid), self._later)
        self._held = _Held(step.obs, shown.obs, memory, wrapper_memory)
