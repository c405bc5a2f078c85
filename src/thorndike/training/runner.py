"""The one runner: every algorithm, every source, every number of seeds.

An iteration is ``collect`` then ``update``. Iterations are scanned into a *segment*, one compiled program with its carry donated, vmapped
over seeds. Between segments the host logs, evaluates and saves. The key of iteration ``i`` is ``fold_in(run key, i)``, so how iterations
are grouped into segments changes nothing.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.training.host_source import HostSource
from thorndike.types import Algorithm, EpisodeStats, Source

_ROWS_OF_NOISE = 65_536
_LONGEST_BLOCK = 2_048
_RUN_ONCE = {"xla_backend_optimization_level": 0}
"""For programs that run once: compiling them costs more than running them (measured: 1.2 s in place of 5.3 s)."""


class Stopwatch:
    """CPU and wall seconds between ``start`` and ``stop``, added up."""

    def __init__(self) -> None:
        """Nothing spent yet."""
        self.cpu = self.wall = 0.0

    def start(self) -> None:
        """Begin a stretch."""
        self._began = time.process_time(), time.perf_counter()

    def stop(self) -> None:
        """End it."""
        self.cpu += time.process_time() - self._began[0]
        self.wall += time.perf_counter() - self._began[1]


class Carry(NamedTuple):
    """All there is between two iterations; every leaf leads with the seed axis ``[S]`` (a host source's state is its own)."""

    learner: PyTree
    source: PyTree


class Report(NamedTuple):
    """What a segment tells, a number a seed: means over its iterations and sums over its episodes."""

    metrics: dict[str, Float[Array, " S"]]
    episodes: EpisodeStats


class Runner(NamedTuple):
    """A learner bound to its source and seeds."""

    init: Callable[[], Carry]
    advance: Callable[[Carry, int, int], tuple[Carry, Report]]
    """carry, first iteration, number of iterations -> carry, report. The carry given is consumed. Splits at the end of the warm-up."""
    steps_per_iteration: int
    """Environment steps an iteration makes for one seed."""
    compile_seconds: Callable[[], float]
    """CPU seconds spent on compiling so far."""
    compile_wall_seconds: Callable[[], float]
    """The same by the clock on the wall."""


def run_keys(seed: int, indices: Sequence[int]) -> Key[Array, " S"]:
    """One key an agent: ``fold_in(key(seed), index)``. Agent ``i`` is the same alone and among others."""
    return jax.vmap(lambda index: jax.random.fold_in(jax.random.key(seed), index))(jnp.asarray(indices, jnp.uint32))


def runner(
    algorithm: Algorithm, source: Source | HostSource, seed: int, indices: Sequence[int], usual_segment: int = _LONGEST_BLOCK
) -> Runner:
    """Bind a learner to its source. ``indices`` name the agents of run ``seed``, usually ``range(S)``.

    Random numbers are drawn for at most ``usual_segment`` iterations at once: no more than a segment uses.
    """
    plain = source.source if isinstance(source, HostSource) else source
    warmup = algorithm.needs.warmup_iterations
    keys = jax.jit(jax.vmap(lambda key: jax.random.split(key, 3)))(run_keys(seed, indices))
    spent = Stopwatch()
    make = partial(_compiled_segment, usual_segment) if plain.compiled else _host_segment
    learning = make(algorithm, plain, algorithm.update, spent)
    warming = make(algorithm, plain, algorithm.observe, spent)

    def init() -> Carry:
        spent.start()
        learner = jax.jit(jax.vmap(algorithm.init), compiler_options=_RUN_ONCE)(keys[:, 0])
        state = jax.jit(jax.vmap(plain.init), compiler_options=_RUN_ONCE)(keys[:, 1]) if plain.compiled else plain.init(keys[:, 1])
        spent.stop()
        return Carry(learner, state)

    def advance(carry: Carry, first: int, count: int) -> tuple[Carry, Report]:
        until = min(max(warmup - first, 0), count)
        if until == 0:
            return learning(carry, keys[:, 2], first, count)
        carry, report = warming(carry, keys[:, 2], first, until)
        if until == count:
            return carry, report
        carry, later = learning(carry, keys[:, 2], first + until, count - until)
        return carry, Report(later.metrics, jax.tree.map(jnp.add, report.episodes, later.episodes))

    return Runner(init, advance, algorithm.needs.rollout_length * plain.spec.num_envs, lambda: spent.cpu, lambda: spent.wall)


class _Keys(NamedTuple):
    draw: Key[Array, "*n"]
    update: Key[Array, "*n"]


def _iteration_keys(loop_key: Key[Array, ""], iteration: Int[Array, "*n"]) -> _Keys:
    both = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(loop_key, i)))(iteration)
    return _Keys(both[:, 0], both[:, 1])


def _compiled_segment(
    usual_segment: int, algorithm: Algorithm, source: Source, learn: Callable, spent: Stopwatch
) -> Callable[[Carry, Key[Array, " S"], int, int], tuple[Carry, Report]]:
    """Iterations scanned in blocks: the random numbers of a block are drawn at once, outside the inner loop.

    The number of iterations is an argument of the compiled program, not part of it: every segment runs the same trace.
    """
    rows = algorithm.needs.rollout_length * source.spec.num_envs
    block = max(1, min(_LONGEST_BLOCK, usual_segment, _ROWS_OF_NOISE // rows))

    def iteration(carry: Carry, noise: PyTree, key: Key[Array, ""]) -> tuple[Carry, Report]:
        state, rollout, episodes = source.collect(carry.source, algorithm.actor(carry.learner), noise)
        learner, metrics = learn(carry.learner, rollout, key)
        return Carry(learner, state), Report(metrics, episodes)

    def segment(carry: Carry, loop_key: Key[Array, ""], first: Int[Array, ""], count: Int[Array, ""]) -> tuple[Carry, Report]:
        def one_block(number: Int[Array, ""], totals: tuple[Carry, Report]) -> tuple[Carry, Report]:
            start = number * block
            keys = _iteration_keys(loop_key, first + start + jnp.arange(block, dtype=jnp.int32))
            noise = jax.vmap(source.draw)(keys.draw)

            def one(i: Int[Array, ""], totals: tuple[Carry, Report]) -> tuple[Carry, Report]:
                carry, report = totals
                carry, latest = iteration(carry, jax.tree.map(lambda x: x[i], noise), keys.update[i])
                return carry, jax.tree.map(jnp.add, report, latest)

            return jax.lax.fori_loop(0, jnp.minimum(block, count - start), one, totals)

        shapes = jax.eval_shape(lambda c, key: iteration(c, source.draw(key), key)[1], carry, loop_key)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        carry, report = jax.lax.fori_loop(0, -(-count // block), one_block, (carry, empty))
        return carry, report._replace(metrics=jax.tree.map(lambda total: total / count, report.metrics))

    traced = jax.jit(jax.vmap(segment, in_axes=(0, 0, None, None)), donate_argnums=0)
    programs: list[Callable] = []

    def run(carry: Carry, loop_keys: Key[Array, " S"], first: int, count: int) -> tuple[Carry, Report]:
        numbers = np.int32(first), np.int32(count)
        if not programs:
            spent.start()
            programs.append(traced.lower(carry, loop_keys, *numbers).compile())
            spent.stop()
        return programs[0](carry, loop_keys, *numbers)

    return run


def _host_segment(
    algorithm: Algorithm, source: Source, learn: Callable, spent: Stopwatch
) -> Callable[[Carry, Key[Array, " S"], int, int], tuple[Carry, Report]]:
    """The same iterations, stepped from Python."""

    def prepare(learner: PyTree, loop_key: Key[Array, ""], iteration: Int[Array, ""]) -> tuple[PyTree, PyTree, Key[Array, ""]]:
        keys = _iteration_keys(loop_key, iteration[None])
        return algorithm.actor(learner), source.draw(keys.draw[0]), keys.update[0]

    prepare_all = jax.jit(jax.vmap(prepare, in_axes=(0, 0, None)))
    learn_all = jax.jit(jax.vmap(learn), donate_argnums=0)
    seen: list[bool] = []

    def run(carry: Carry, loop_keys: Key[Array, " S"], first: int, count: int) -> tuple[Carry, Report]:
        learner, state = carry
        reports: list[Report] = []
        for iteration in range(first, first + count):
            if not seen:
                spent.start()
            actor, noise, key = prepare_all(learner, loop_keys, np.int32(iteration))
            state, rollout, episodes = source.collect(state, actor, noise)
            learner, metrics = learn_all(learner, rollout, key)
            reports.append(Report(metrics, episodes))
            if not seen:
                seen.append(True)
                spent.stop()
        metrics = jax.tree.map(lambda *rows: sum(rows) / len(rows), *[report.metrics for report in reports])
        episodes = jax.tree.map(lambda *rows: sum(rows), *[report.episodes for report in reports])
        return Carry(learner, state), Report(metrics, episodes)

    return run
