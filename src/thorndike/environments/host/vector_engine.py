"""A user's own ``gymnasium.vector.VectorEnv`` as a host engine, in any of the three modes of https://farama.org/Vector-Autoreset-Mode.

What a learner gets:

* SAME_STEP: ``obs`` is after the reset, ``next_obs`` is ``infos["final_obs"]``.
* NEXT_STEP: at an end ``obs`` is the terminal observation, whose action is ignored; the row after it has ``valid=False``.
* DISABLED: ended environments are reset here by mask, so it looks like SAME_STEP.

What the vector gives is checked (``checks.py`` says what and how often); a fault is named in a UserError with its environment, where that
can be told, and its step. Gymnasium's ``AsyncVectorEnv`` gets the time-outs, and after a fault its processes are ended. Of any other
vector a call that hangs is not seen.
"""

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from thorndike.environments.host.arrays import action_converter, check_seeds, check_spaces, duplicate, take, with_rows
from thorndike.environments.host.async_vector import end, reset_within, step_within, worker_fault
from thorndike.environments.host.checks import (
    all_finite,
    bounds_hold,
    check_values,
    checked_batch,
    checked_rows,
    due,
    finite_test,
    not_finite,
    reward_not_finite,
    storer,
)
from thorndike.environments.host.faults import DEFAULT_TIMEOUTS, Timeouts, as_fault, named, reset_name
from thorndike.environments.host.steps import host_spec, host_step
from thorndike.errors import UserError
from thorndike.types import Observation, Step

_GIVES = "(observations, rewards, terminated, truncated, infos)"


class VectorEngine:
    """A ``gymnasium.vector.VectorEnv`` of any autoreset mode. Without that entry in its metadata it is NEXT_STEP, as Gymnasium assumes."""

    def __init__(
        self,
        vector: VectorEnv,
        id: str,
        max_episode_steps: int | None = None,
        engine: str = "gymnasium",
        timeouts: Timeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        """Takes over `vector`. Raises UserError if a learner cannot be shown its spaces."""
        space, count = vector.single_observation_space, vector.num_envs
        check_spaces(space, vector.single_action_space, id)
        self.spec = host_spec(id, space, vector.single_action_space, count, max_episode_steps, engine)
        self._vector, self._timeouts = vector, timeouts
        self._mode = AutoresetMode(vector.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._convert = action_converter(vector.single_action_space)
        self._store, self._is_finite = storer(space), finite_test(space)
        self._bounds = bounds_hold(vector.envs[0] if isinstance(vector, SyncVectorEnv) else vector)
        self._ended = np.zeros(count, np.bool_)
        self._steps = 0

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Every environment from its own seed: obs ``[B, ...]``. Raises UserError, here and in ``step``, for a fault of an environment.

        Gymnasium's sync and subprocess vectors take a seed each; any other vector takes one number, so it gets the first.
        """
        seeds = check_seeds(seeds, self.spec.num_envs)
        when = reset_name(self._steps)
        try:
            obs = self._checked(self._fresh(seeds))
        except Exception as error:
            raise self._named(error, "(observations, infos)", when, self._timeouts.reset) from error
        self._ended = np.zeros(self.spec.num_envs, np.bool_)
        return obs

    def step(self, actions: np.ndarray) -> Step:
        """One action each: ``int[B]``, ``int[B, K]`` or ``float[B, D]`` (clipped to the bounds) -> Step of fresh arrays ``[B, ...]``."""
        actions = self._convert(actions)
        self._steps += 1
        try:
            step = self._stepped(actions)
        except Exception as error:
            raise self._named(error, _GIVES, f"step {self._steps}", self._timeouts.step) from error
        if step.obs is not step.next_obs:
            self._check_finite(step.next_obs, f"step {self._steps}")
            self._check_finite(step.obs, reset_name(self._steps))
        return step

    def close(self) -> None:
        """Closes the vector."""
        self._vector.close()

    def _fresh(self, seeds: list[int]) -> Observation:
        if isinstance(self._vector, AsyncVectorEnv):
            return reset_within(self._vector, self._timeouts.reset, seeds)
        takes_one_each = isinstance(self._vector.unwrapped, SyncVectorEnv | AsyncVectorEnv)
        # Gymnasium annotates what all vectors take, a number; its own two take a list.
        observation, _ = self._vector.reset(seed=cast("int", seeds) if takes_one_each else seeds[0])
        return observation

    def _stepped(self, actions: np.ndarray) -> Step:
        if isinstance(self._vector, AsyncVectorEnv):
            outcome = step_within(self._vector, self._timeouts.step, actions)
        else:
            outcome = self._vector.step(actions)
        observation, reward, terminated, truncated, infos = outcome
        valid = ~self._ended if self._mode is AutoresetMode.NEXT_STEP else np.ones(self.spec.num_envs, np.bool_)
        terminated, truncated = (
            checked_rows(flags, self.spec.num_envs, name, "biu").astype(np.bool_) & valid
            for name, flags in (("terminated", terminated), ("truncated", truncated))
        )
        self._ended = terminated | truncated
        obs, next_obs = self._before_and_after_reset(self._checked(observation), infos)
        reward = np.where(valid, checked_rows(reward, self.spec.num_envs, "rewards", "biuf"), 0).astype(np.float32)
        if not all_finite(reward):
            raise reward_not_finite(reward)
        cost = self._cost(infos, valid)
        return host_step(obs, next_obs, reward=reward, cost=cost, terminated=terminated, truncated=truncated, valid=valid)

    def _checked(self, observation: Observation) -> Observation:
        """The batch as a learner sees it."""
        batch = checked_batch(self.spec.observation_space, observation, self.spec.num_envs)
        if not self._is_finite(batch):
            raise not_finite(self.spec.observation_space, batch)
        if due(self._steps):
            check_values(self.spec.observation_space, batch, self._bounds)
        return batch

    def _check_finite(self, obs: Observation, when: str) -> None:
        if not self._is_finite(obs):
            raise self._named(not_finite(self.spec.observation_space, obs), _GIVES, when, self._timeouts.step)

    def _named(self, error: Exception, expected: str, when: str, seconds: float) -> UserError:
        """The error a user reads. Of Gymnasium's processes none is left, for with one of them the vector is lost."""
        fault = None
        if isinstance(self._vector, AsyncVectorEnv):
            fault = worker_fault(self._vector, error, seconds)
            end(self._vector)
        fault = fault or as_fault(error, __file__, expected)
        return named(fault, self.spec.id, "environment", self.spec.num_envs, when)

    def _before_and_after_reset(self, batch: Observation, infos: Mapping[str, object]) -> tuple[Observation, Observation]:
        """What the policy sees next, and the true successors."""
        if self._mode is AutoresetMode.NEXT_STEP or not self._ended.any():
            return batch, batch
        if self._mode is AutoresetMode.DISABLED:
            # What rows that were not reset hold is the vector's affair.
            fresh = checked_batch(self.spec.observation_space, self._reset_ended(), self.spec.num_envs)
            return with_rows(batch, self._ended, take(fresh, self._ended)), batch
        return batch, self._true_successors(batch, infos)

    def _reset_ended(self) -> Observation:
        options = {"reset_mask": self._ended.copy()}
        if isinstance(self._vector, AsyncVectorEnv):
            return reset_within(self._vector, self._timeouts.reset, None, options)
        return self._vector.reset(options=options)[0]

    def _true_successors(self, batch: Observation, infos: Mapping[str, object]) -> Observation:
        final = infos.get("final_obs")
        if final is None:
            raise UserError(
                "says autoreset_mode SAME_STEP but gave no infos['final_obs'] at an end: give the observation before the "
                "reset there, or declare the mode it has in metadata['autoreset_mode']"
            )
        if not (isinstance(final, np.ndarray) and final.dtype == object):
            return with_rows(batch, self._ended, take(checked_batch(self.spec.observation_space, final, self.spec.num_envs), self._ended))
        successors = duplicate(batch)
        for row in np.flatnonzero(self._ended).tolist():
            self._store(successors, row, final[row])
        return successors

    def _cost(self, infos: Mapping[str, object], valid: np.ndarray) -> np.ndarray:
        """``infos["cost"]``; in SAME_STEP that of an ended row is in ``infos["final_info"]``, for ``infos`` tells of the reset."""
        cost = np.zeros(self.spec.num_envs, np.float32)
        if "cost" in infos:
            cost[:] = np.asarray(infos["cost"], np.float32)
        final = infos.get("final_info")
        if self._mode is AutoresetMode.SAME_STEP and isinstance(final, Mapping):
            cost[self._ended] = np.asarray(final.get("cost", np.zeros_like(cost)))[self._ended]
        return np.where(valid, cost, 0).astype(np.float32)
