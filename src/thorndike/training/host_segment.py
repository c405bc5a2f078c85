"""A segment on a host engine: the engine stepped from Python, the learners of all seeds held in the way that costs least."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree

from thorndike.training.segment import Carry, Latest, Report, Stopwatch, over_seeds, page_keys, page_length
from thorndike.training.time_shares import Clock, SegmentTimes
from thorndike.types import Algorithm, EpisodeStats, Metrics, Rollout, Source


class _Learners(NamedTuple):
    """How the learners of all seeds are held while a host engine steps."""

    take: Callable[[PyTree], PyTree]
    """learners as a carry has them -> as they are held. May consume them."""
    actors: Callable[[PyTree], PyTree]
    """-> actors ``[S, ...]``."""
    learn: Callable[[PyTree, Rollout, Key[Array, " S"]], tuple[PyTree, Metrics]]
    """held, rollouts ``[S, T, B, ...]``, keys -> held, metrics ``[S]``. What is held is consumed."""
    give: Callable[[PyTree], PyTree]
    """-> as a carry has them."""


def _stacked(algorithm: Algorithm, learn: Callable) -> _Learners:
    """One array for all seeds, one program."""
    return _Learners(
        take=lambda learner: learner,
        actors=jax.jit(jax.vmap(algorithm.actor)),
        learn=jax.jit(over_seeds(learn), donate_argnums=0),
        give=lambda learner: learner,
    )


def _alone(algorithm: Algorithm, learn: Callable) -> _Learners:
    """One seed: its axis is taken off inside the program, so that not even a moment's copy is made of a replay of gigabytes."""

    def one(*arguments: PyTree) -> PyTree:
        return _one_of_one(learn(*_the_one(arguments)))

    return _stacked(algorithm, learn)._replace(learn=jax.jit(one, donate_argnums=0))


def _the_one(tree: PyTree) -> PyTree:
    """The only seed of arrays ``[1, ...]``. By another shape, not by an index, which would copy."""
    return jax.tree.map(lambda x: x.reshape(x.shape[1:]), tree)


def _one_of_one(tree: PyTree) -> PyTree:
    return jax.tree.map(lambda x: x[None], tree)


def learning_of_one(learn: Callable) -> Callable:
    """``learn`` of seed ``i`` among rollouts and keys ``[S, ...]``: learner, rollouts, keys, i -> learner, metrics. Consumes the learner.

    The learner has no seed axis, since XLA would copy the replay out of a stack and into it again (SAC with 1,000,000 transitions).
    """
    return jax.jit(lambda learner, rollout, keys, i: learn(learner, jax.tree.map(lambda x: x[i], rollout), keys[i]), donate_argnums=0)


def _apart(algorithm: Algorithm, learn: Callable) -> _Learners:
    """A learner a seed."""
    actor, learn_one = jax.jit(algorithm.actor), learning_of_one(learn)
    stack = jax.jit(lambda trees: jax.tree.map(lambda *rows: jnp.stack(rows), *trees))

    # Of one seed the same memory in another shape: a copy of its replay at each log point costs TD3 15 % of its time.
    only, again = jax.jit(_the_one, donate_argnums=0), jax.jit(_one_of_one, donate_argnums=0)

    def take(learner: PyTree) -> PyTree:
        seeds = jax.tree.leaves(learner)[0].shape[0]
        return [only(learner)] if seeds == 1 else [jax.tree.map(lambda x, i=i: x[i], learner) for i in range(seeds)]

    def give(held: PyTree) -> PyTree:
        return again(held[0]) if len(held) == 1 else stack(held)

    def learn_each(held: PyTree, rollout: Rollout, keys: Key[Array, " S"]) -> tuple[PyTree, Metrics]:
        outcomes = [learn_one(learner, rollout, keys, np.int32(i)) for i, learner in enumerate(held)]
        return [learner for learner, _ in outcomes], stack([metrics for _, metrics in outcomes])

    return _Learners(take, lambda held: stack([actor(learner) for learner in held]), learn_each, give)


def host_segment(
    algorithm: Algorithm, source: Source, learn: Callable, spent: Stopwatch, clock: Clock | None, latest: Latest
) -> Callable[[Carry, int, int], tuple[Carry, Report]]:
    """The same iterations, stepped from Python. ``latest`` is given the last rollout."""
    page = page_length(algorithm, source.spec.num_envs)
    on_cpu, replays = jax.default_backend() == "cpu", not algorithm.needs.on_policy
    stacked, alone, apart = (hold(algorithm, learn) for hold in (_stacked, _alone, _apart))

    def draw(loop_key: Key[Array, ""], number: Int[Array, ""]) -> tuple[PyTree, Key[Array, " iterations"]]:
        keys = page_keys(loop_key, number)
        return source.draw(keys.draw, page), jax.vmap(lambda i: jax.random.fold_in(keys.update, i))(jnp.arange(page))

    draw_page = jax.jit(jax.vmap(draw, in_axes=(0, None)))
    turn_to = jax.jit(lambda drawn, i: jax.tree.map(lambda x: x[:, i], drawn))
    seen: list[bool] = []

    def run(carry: Carry, first: int, count: int) -> tuple[Carry, Report]:
        # Of a memory of transitions XLA makes a copy at every step where the axis is taken off inside (SAC: 38 steps a second, not 180).
        few = alone if carry.loop_key.shape[0] == 1 and source.spec.frames > 1 else apart
        learners = few if on_cpu and replays else stacked
        held, state, loop_keys = learners.take(carry.learner), carry.source, carry.loop_key
        reports: list[Report] = []
        times = None if clock is None else SegmentTimes(clock)
        for iteration in range(first, first + count):
            if not seen:
                spent.start()
            if iteration == first or iteration % page == 0:
                drawn = draw_page(loop_keys, np.int32(iteration // page))
            noise, keys = turn_to(drawn, np.int32(iteration % page))
            actors = learners.actors(held)
            began = time.perf_counter()
            state, rollout, episodes = source.collect(state, actors, noise)
            collected = time.perf_counter()
            held, metrics = learners.learn(held, rollout, keys)
            if times is not None:
                times.add(collected - began, time.perf_counter() - collected)
            reports.append(Report(metrics, episodes))
            if not seen:
                seen.append(True)
                spent.stop()
        latest.rollout, shares = rollout, None if times is None else times.shares()
        return Carry(learners.give(held), state, loop_keys), _together(reports)._replace(shares=shares)

    return run


def _together(reports: Sequence[Report]) -> Report:
    """The report of a segment. Added up by NumPy: a compiled addition for each number of each iteration costs SAC 4 % of its time."""
    rows = jax.device_get([(report.metrics, report.episodes) for report in reports])
    metrics = {name: np.mean([row[name] for row, _ in rows], 0) for name in rows[0][0]}
    return Report(metrics, EpisodeStats(*(np.sum(column, 0) for column in zip(*(episodes for _, episodes in rows), strict=True))))
