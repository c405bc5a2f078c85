"""Actor threads: several pools of host environments, each played by a thread of its own, feed one learner while it learns.

A thread plays one rollout at a time and is given its next one, with the actor of that moment, when the learner takes the last: no queue
ever holds more than a rollout a thread. On the *fixed* schedule the learner takes the rollouts in turn, so with N threads each is played
by the actor of N updates ago (fewer at a checkpoint, where all begin afresh) and two runs are equal, bit for bit. On the *free* schedule
it takes whichever is there first, and no two runs are.

A fault of an environment ends the run with its name, as everywhere; with ``restarts`` the pool that had it is made anew, the episodes
under way are cut at the last whole step, and the rollout goes on: no step that a pool gave is lost or used twice.
"""

import threading
from collections.abc import Callable, Sequence
from queue import Queue
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PyTree

from thorndike.errors import UserError
from thorndike.training.acting import Acting, acting
from thorndike.training.host_source import (
    HostEngine,
    HostSource,
    HostSourceState,
    Pool,
    Rolling,
    cut,
    environment_seeds,
    fresh_state,
)
from thorndike.training.notices import notice
from thorndike.training.time_shares import Clock
from thorndike.types import Algorithm, EpisodeStats, Noise, Observation, Rollout, Source, Step, Wrapper

SCHEDULES = ("fixed", "free")
_GRACE_S = 5.0
"""Seconds a thread has to end the step it is in."""


class ActorThreads(NamedTuple):
    """How actor threads are asked for."""

    threads: int = 0
    """0: the environments are stepped in turn with the learner."""
    schedule: str = "fixed"
    restarts: int = 0
    """How often pools may be made anew after a fault of an environment, in all."""


class ThreadedState(NamedTuple):
    """What lies between two rollouts and can be restored; the rest is under way in the threads."""

    statistics: PyTree
    collected: int


class Job(NamedTuple):
    """A rollout to be played."""

    state: HostSourceState | None
    """Where the pool stands; None: it begins afresh, with ``statistics`` and from the seeds of ``segment``."""
    statistics: PyTree
    segment: int
    actor: PyTree
    keys: Key[Array, " S"]
    slot: int
    """Which of the random numbers of ``keys`` are this rollout's."""


Answer: TypeAlias = tuple[int, Rolling | BaseException]
"""What a thread says to a job: its lane, and the rollout or what went wrong."""


class _Stopped(Exception):
    """The run is over: the rollout under way is not needed."""


class Restarts:
    """The pools that may still be made anew, shared by all threads."""

    def __init__(self, allowed: int) -> None:
        """``allowed`` in all."""
        self._allowed, self._made, self._lock = allowed, 0, threading.Lock()

    def take(self, fault: UserError) -> None:
        """Note one more. Raises ``fault`` if none is left."""
        with self._lock:
            if self._made >= self._allowed:
                raise fault
            self._made += 1
            notice(f"{fault}; its pool is made anew ({self._made} of {self._allowed} restarts)")


class Lane:
    """One pool of environments and the thread that plays in it."""

    def __init__(
        self,
        number: int,
        engine: HostEngine,
        build: Callable[[], HostEngine],
        seeds_of: Callable[[int, int, int], list[int]],
        seeds: int,
        restarts: Restarts,
    ) -> None:
        """``build`` makes another engine like ``engine``; ``seeds_of(segment, lane, restart)`` are its environments' seeds."""
        self.number, self.jobs = number, Queue[Job | None](maxsize=1)
        self._build, self._seeds_of, self._seeds, self._restarts = build, seeds_of, seeds, restarts
        self._pool, self._renewed, self._segment = self._as_pool(engine), 0, 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def run(self, play: Callable[["Lane", Job], Rolling], made: "Queue[Answer]") -> None:
        """Start the thread."""

        def work() -> None:
            while (job := self.jobs.get()) is not None:
                try:
                    made.put((self.number, play(self, job)))
                except _Stopped:
                    return
                except BaseException as error:
                    # Whatever it is, the learner must hear of it: it waits for this thread.
                    made.put((self.number, error))

        self._thread = threading.Thread(target=work, daemon=True, name=f"actor {self.number}")
        self._thread.start()

    def begin(self, segment: int) -> Observation:
        """First observations ``[S, B, ...]`` of a segment."""
        self._segment, self._renewed = segment, 0
        return self._reset()

    def step(self, action: Array) -> Step:
        """Actions ``[S, B, ...]`` -> Step ``[S, B, ...]``."""
        if self._stop.is_set():
            raise _Stopped
        return self._pool.step(action)

    def renew(self, fault: UserError) -> Observation:
        """First observations of a pool in the place of the one that had ``fault``. Raises ``fault`` where that is not allowed."""
        if self._stop.is_set():
            raise _Stopped
        self._restarts.take(fault)
        self._pool.engine.close()
        self._pool = self._as_pool(self._build())
        self._renewed += 1
        return self._reset()

    def tell_to_stop(self) -> None:
        """End after the step under way."""
        self._stop.set()
        if self.jobs.empty():
            self.jobs.put(None)

    def close(self) -> None:
        """Wait for the thread, then free the engine, which ends a step that does not end by itself where the engine can."""
        if self._thread is not None:
            self._thread.join(_GRACE_S)
        self._pool.engine.close()
        if self._thread is not None:
            self._thread.join(_GRACE_S)
            if self._thread.is_alive():
                notice(f"environments of actor thread {self.number} do not come out of their step; the process does not wait for them")

    def _reset(self) -> Observation:
        return self._pool.reset(self._seeds_of(self._segment, self.number, self._renewed))

    def _as_pool(self, engine: HostEngine) -> Pool:
        return Pool(engine, self._seeds, engine.spec.num_envs // self._seeds, Clock())


class Crew:
    """The lanes, what they are to do and what they have made."""

    def __init__(self, lanes: Sequence[Lane], play: Callable[[Lane, Job], Rolling], schedule: str) -> None:
        """Threads start at once and wait."""
        self._lanes, self._free = lanes, schedule == "free"
        self._made: Queue[Answer] = Queue(maxsize=2 * len(lanes))
        self._early: dict[int, Rolling] = {}
        for lane in lanes:
            lane.run(play, self._made)

    def give(self, lane: int, job: Job) -> None:
        """Have a lane that is idle play."""
        self._lanes[lane].jobs.put(job)

    def take(self, turn: int) -> tuple[int, Rolling]:
        """The lane and its rollout: that of lane ``turn``, or on the free schedule the first that is there. Raises a thread's error."""
        while not self._early or (turn not in self._early and not self._free):
            lane, outcome = self._made.get()
            if isinstance(outcome, BaseException):
                raise outcome
            self._early[lane] = outcome
        lane = next(iter(self._early)) if self._free else turn
        return lane, self._early.pop(lane)

    def close(self) -> None:
        """Stop all threads and free all engines."""
        for lane in self._lanes:
            lane.tell_to_stop()
        for lane in self._lanes:
            lane.close()


class ThreadedSource(NamedTuple):
    """A host source fed by threads, and how they are stopped."""

    source: HostSource
    close: Callable[[], None]


def threaded_source(
    engines: Sequence[HostEngine],
    build: Callable[[], HostEngine],
    algorithm: Algorithm,
    wrapper: Wrapper,
    seed: int,
    indices: Sequence[int],
    reseed_every: int,
    asked: ActorThreads,
) -> ThreadedSource:
    """Rollouts of ``engines``, one a thread, each a pool of ``len(indices)`` seeds by ``B`` environments; ``build`` makes another.

    As in ``host_source``, after every ``reseed_every`` rollouts all environments start afresh, from seeds that follow from the run's.
    """
    seeds, length, threads = len(indices), algorithm.needs.rollout_length, len(engines)
    spec = engines[0].spec._replace(num_envs=engines[0].spec.num_envs // seeds)
    moves = acting(algorithm, wrapper, spec.action_space, seeds, spec.num_envs)
    learn = jax.jit(jax.vmap(wrapper.learn)) if wrapper.name else lambda *unchanged: unchanged
    # Copied, because the learner's own arrays are given away in its next update.
    copied = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))
    drawn = jax.jit(jax.vmap(lambda key, slot: algorithm.draw(jax.random.fold_in(key, slot), length), in_axes=(0, None)))

    def seeds_of(segment: int, lane: int, restart: int) -> list[int]:
        return environment_seeds(seed, indices, spec.num_envs, segment, lane, restart)

    restarts = Restarts(asked.restarts)
    lanes = [Lane(number, engine, build, seeds_of, seeds, restarts) for number, engine in enumerate(engines)]
    crew = Crew(lanes, _player(moves, drawn, length), asked.schedule)

    def init(keys: Key[Array, " S"]) -> ThreadedState:
        del keys
        return ThreadedState(jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *jnp.shape(x))), wrapper.statistics(spec)), 0)

    def collect(state: ThreadedState, actor: PyTree, noise: Noise) -> tuple[ThreadedState, Rollout, EpisodeStats]:
        segment, place = divmod(state.collected, reseed_every)
        actor = copied(actor)
        if place == 0:
            for lane in range(min(threads, reseed_every)):
                crew.give(lane, Job(None, state.statistics, segment, actor, noise, 1 + lane))
        lane, rolling = crew.take(place % threads)
        goes_on = place + threads < reseed_every
        if not goes_on:
            rolling.rows[-1] = cut(rolling.rows[-1])
        statistics, wrapper_memory, rollout = learn(state.statistics, rolling.state.wrapper_memory, rolling.rollout())
        if goes_on:
            stands = rolling.state._replace(wrapper_memory=wrapper_memory, statistics=statistics)
            crew.give(lane, Job(stands, statistics, segment, actor, noise, 0))
        return ThreadedState(statistics, state.collected + 1), rollout, EpisodeStats(*rolling.tally.sums)

    source = Source(init, jax.random.split, collect, lambda state: state.statistics, wrapper.spec(spec), compiled=False)
    return ThreadedSource(HostSource(source, ThreadedState), crew.close)


def _player(moves: Acting, drawn: Callable[[Key[Array, " S"], np.int32], Noise], length: int) -> Callable[[Lane, Job], Rolling]:
    """How a job is done."""

    def play(lane: Lane, job: Job) -> Rolling:
        state = job.state
        if state is None:
            state = fresh_state(moves, job.statistics, _first(lane, job.segment), 0)
        noise = drawn(job.keys, np.int32(job.slot))
        rolling = Rolling(moves, state)
        while len(rolling.rows) < length:
            try:
                rolling.advance(lane, job.actor, noise, length)
            except UserError as fault:
                rolling.begin_again(_renewed(lane, fault))
        return rolling

    return play


def _first(lane: Lane, segment: int) -> Observation:
    """First observations of a segment, from a new pool if the old one cannot begin."""
    try:
        return lane.begin(segment)
    except UserError as fault:
        return _renewed(lane, fault)


def _renewed(lane: Lane, fault: UserError) -> Observation:
    """First observations of a new pool, or of the one after it, as long as restarts are left."""
    while True:
        try:
            return lane.renew(fault)
        except UserError as again:
            if again is fault:
                raise
            fault = again
