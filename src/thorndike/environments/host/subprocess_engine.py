"""One process an environment, as a host engine (``subprocess``): for environments that are slow in Python.

Not Gymnasium's ``AsyncVectorEnv``, because of what it does when something goes wrong: it waits for ever for a process that hangs, leaves
those behind when the parent is killed, casts wrong dtypes and broadcasts wrong shapes, and does not say who failed. Here a process that
dies, hangs, raises or answers wrongly is named in a UserError with the step, then all processes are ended; what the others did in that
step is dropped, so no false transition is ever seen. Only constructors are sent as code, the way Gymnasium sends them; actions and
observations go through shared memory, and answers are one byte, or JSON.

Each process is an interpreter of its own, not a fork: JAX's threads do not survive one. Scripts need no ``if __name__ == "__main__":``.
"""

import math
import os
import select
import time
from collections.abc import Sequence

import gymnasium
import numpy as np

from thorndike.environments.host.arrays import action_converter, check_seeds, check_spaces, duplicate, take, with_rows
from thorndike.environments.host.faults import DEFAULT_TIMEOUTS, Fault, Timeouts, hung, named, one_line, reset_name
from thorndike.environments.host.goals import find_goal
from thorndike.environments.host.gymnasium_engine import MakeEnv
from thorndike.environments.host.shared_block import create_block
from thorndike.environments.host.steps import host_spec, host_step
from thorndike.environments.host.worker import RESET, STEP, packed
from thorndike.environments.host.worker_process import WorkerProcess, end_all
from thorndike.errors import UserError
from thorndike.types import Observation, Step

_GRACE = 5.0
"""Seconds an environment has to close itself when the pool is closed."""
_GRACE_AFTER_FAULT = 1.0
_LOOK = 0.5
"""Seconds after which a worker that is silent is looked at: a child of its own may hold its connection open."""


class SubprocessEngine:
    """A pool of worker processes, one for each maker; each resets its environment in the step that ends an episode."""

    def __init__(
        self,
        makers: Sequence[MakeEnv],
        id: str,
        max_episode_steps: int | None = None,
        timeouts: Timeouts = DEFAULT_TIMEOUTS,
    ) -> None:
        """Makes one environment here, for its spaces, and one in each process; `timeouts` are for the processes.

        Raises UserError if a learner cannot be shown the spaces, or if a process does not come up.
        """
        probe = makers[0]()
        observation, action = probe.observation_space, probe.action_space
        goal = find_goal(probe)
        probe.close()
        check_spaces(observation, action, id)
        self.spec = host_spec(id, observation, action, len(makers), max_episode_steps, "subprocess")._replace(goal=goal)
        self._convert, self._timeouts, self._steps = action_converter(action), timeouts, 0
        self._workers: list[WorkerProcess] = []
        file, self._block = create_block(observation, action, len(makers))
        try:
            for row, make in enumerate(makers):
                self._workers.append(WorkerProcess(row, len(makers), file, _constructor(make, observation, action, id)))
        except BaseException:
            self._end(0.0)
            raise
        finally:
            os.close(file)
        self._listen("construction", timeouts.start)

    def reset(self, seeds: Sequence[int]) -> Observation:
        """Every environment from its own seed: obs ``[B, ...]``. Raises UserError, here and in ``step``, for a fault of an environment."""
        seeds = check_seeds(seeds, self.spec.num_envs)
        for worker, seed in zip(self._running(), seeds, strict=True):
            worker.tell(RESET, seed)
        self._listen(reset_name(self._steps), self._timeouts.reset)
        return duplicate(self._block.obs)

    def step(self, actions: np.ndarray) -> Step:
        """One action each: ``int[B]``, ``int[B, K]`` or ``float[B, D]`` (clipped to the bounds) -> Step of fresh arrays ``[B, ...]``."""
        block, actions = self._block, self._convert(actions)
        if len(actions) != self.spec.num_envs:
            raise ValueError(f"step needs one action for each of the {self.spec.num_envs} environments, not {len(actions)}")
        block.action[...] = actions
        self._steps += 1
        block.resetting[...] = False
        for worker in self._running():
            worker.tell(STEP)
        self._listen(f"step {self._steps}", self._timeouts.step)
        terminated, truncated = block.terminated.copy(), block.truncated.copy()
        next_obs, ended = duplicate(block.next_obs), np.flatnonzero(terminated | truncated)
        obs = with_rows(next_obs, ended, take(block.obs, ended)) if ended.size else next_obs
        return host_step(
            obs,
            next_obs,
            reward=block.reward.copy(),
            cost=block.cost.copy(),
            terminated=terminated,
            truncated=truncated,
            valid=np.ones(self.spec.num_envs, np.bool_),
        )

    def close(self) -> None:
        """Closes every environment and ends its process."""
        self._end(_GRACE)

    def _listen(self, when: str, seconds: float) -> None:
        """Wait for one answer of each worker. Raises UserError for the first that fails; then no process is left."""
        try:
            self._await_all(seconds)
        except Fault as fault:
            self._end(_GRACE_AFTER_FAULT)
            if fault.row is not None and self._block.resetting[fault.row]:
                when = reset_name(self._steps)
            raise self._named(fault, when) from fault
        except BaseException:
            # Answers that nobody has taken would be taken for those of the next step.
            self._end(_GRACE_AFTER_FAULT)
            raise

    def _await_all(self, seconds: float) -> None:
        """Take the answers as they come. Raises Fault for a worker that is gone, late, or says so itself."""
        waiting = {worker.connection.fileno(): worker for worker in self._workers}
        poll = select.poll()
        for number in waiting:
            poll.register(number, select.POLLIN)
        began = time.monotonic()
        while waiting:
            left = began - time.monotonic() + min(self._limit(worker, seconds) for worker in waiting.values())
            answers = poll.poll(math.ceil(1000 * max(0.0, min(left, _LOOK))))
            for number, _ in answers:
                poll.unregister(number)
                waiting.pop(number).hear()
            if not answers:
                self._check_silent(list(waiting.values()), time.monotonic() - began, seconds)

    def _check_silent(self, workers: list[WorkerProcess], passed: float, seconds: float) -> None:
        for worker in workers:
            if not worker.is_alive():
                raise worker.end_fault()
            if passed >= self._limit(worker, seconds):
                worker.kill()
                self._workers.remove(worker)
                raise hung(self._limit(worker, seconds), worker.row)

    def _limit(self, worker: WorkerProcess, seconds: float) -> float:
        return seconds + self._timeouts.reset if self._block.resetting[worker.row] else seconds

    def _running(self) -> list[WorkerProcess]:
        if not self._workers:
            raise ValueError(f"the processes of {self.spec.id} are ended: make the engine anew")
        return self._workers

    def _named(self, fault: Fault, when: str) -> UserError:
        error = named(fault, self.spec.id, "worker", self.spec.num_envs, when)
        for note in getattr(fault, "__notes__", []):
            error.add_note(note)
        return error

    def _end(self, grace: float) -> None:
        workers, self._workers = self._workers, []
        end_all(workers, grace)


def _constructor(make: MakeEnv, observation: gymnasium.Space, action: gymnasium.Space, id: str) -> bytes:
    try:
        return packed(make, observation, action)
    except Exception as error:
        raise UserError(
            f"{id} cannot be sent to a worker process ({type(error).__name__}: {one_line(error)}): give a function that makes it, "
            "or use engine='gymnasium'"
        ) from error
