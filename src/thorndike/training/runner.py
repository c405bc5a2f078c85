"""The one runner: every algorithm, every source, every number of seeds.

An iteration is ``collect`` then ``update``. Iterations are scanned into a *segment*, one compiled program for all seeds, with its carry
donated. Between segments the host logs, evaluates and saves. The random numbers of iteration ``i`` follow from
``fold_in(run key, page of i)``, so how iterations are grouped into segments changes nothing.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, PyTree, UInt32

from thorndike.training.devices import over_devices, placed
from thorndike.training.host_segment import host_segment
from thorndike.training.host_source import HostSource
from thorndike.training.segment import RUN_ONCE, Carry, Latest, Report, Stopwatch, compile_segment, over_seeds, page_keys, page_length
from thorndike.types import Algorithm, Metrics, Rollout, Source


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
    inspect: Callable[[Carry, int], Rollout] | None = None
    """carry, iteration -> the rollout ``[S, T, B, ...]`` that this iteration will learn from; the carry is kept. None for host engines,
    which check what they return as it comes."""
    dynamics: Callable[[Carry, int], Metrics] | None = None
    """carry, the iteration it has come to -> what is logged at a few log points only ``[S]``; the carry is kept. None for learners that
    have none."""


def run_keys(seed: int, indices: UInt32[Array, " S"]) -> Key[Array, " S"]:
    """One key an agent: ``fold_in(key(seed), index)``. Agent ``i`` is the same alone and among others."""
    return jax.vmap(lambda index: jax.random.fold_in(jax.random.key(seed), index))(indices)


class AgentKeys(NamedTuple):
    """What all random numbers of an agent follow from, ``[S]``."""

    learner: Key[Array, " S"]
    source: Key[Array, " S"]
    loop: Key[Array, " S"]


def agent_keys(seed: int, indices: UInt32[Array, " S"]) -> AgentKeys:
    """The keys of agents ``indices`` of run ``seed``."""
    keys = jax.vmap(lambda key: jax.random.split(key, 3))(run_keys(seed, indices))
    return AgentKeys(keys[:, 0], keys[:, 1], keys[:, 2])


def runner(algorithm: Algorithm, source: Source | HostSource, seed: int, indices: Sequence[int], devices: int = 1) -> Runner:
    """Bind a learner to its source. ``indices`` name the agents of run ``seed``, usually ``range(S)``.

    With a compiled source, ``devices`` (which divide S) train a share of the agents each.
    """
    plain, clock = (source.source, source.clock) if isinstance(source, HostSource) else (source, None)
    warmup = algorithm.needs.warmup_iterations
    spent = Stopwatch()
    latest = Latest()
    make = partial(_compiled_segment, devices) if plain.compiled else partial(host_segment, clock=clock, latest=latest)
    learning = make(algorithm, plain, algorithm.update, spent)
    warming = make(algorithm, plain, algorithm.observe, spent)

    def begin(indices: UInt32[Array, " S"]) -> tuple[Carry, Key[Array, " S"]]:
        keys = agent_keys(seed, indices)
        state = jax.vmap(plain.init)(keys.source) if plain.compiled else ()
        return Carry(jax.vmap(algorithm.init)(keys.learner), state, keys.loop), keys.source

    def init() -> Carry:
        spent.start()
        carry, source_keys = jax.jit(begin, compiler_options=RUN_ONCE)(np.asarray(indices, np.uint32))
        if not plain.compiled:
            carry = carry._replace(source=plain.init(source_keys))
        spent.stop()
        return carry

    def advance(carry: Carry, first: int, count: int) -> tuple[Carry, Report]:
        until = min(max(warmup - first, 0), count)
        if until == 0:
            return learning(carry, first, count)
        carry, report = warming(carry, first, until)
        if until == count:
            return carry, report
        carry, later = learning(carry, first + until, count - until)
        return carry, later._replace(episodes=jax.tree.map(jnp.add, report.episodes, later.episodes))

    inspect = _inspector(algorithm, plain, devices) if plain.compiled else None
    per_iteration = algorithm.needs.rollout_length * plain.spec.num_envs
    dynamics = None if algorithm.dynamics is None else _dynamics(algorithm, plain, latest, spent, devices if plain.compiled else 1)
    return Runner(init, advance, per_iteration, lambda: spent.cpu, lambda: spent.wall, inspect, dynamics)


def _collected_again(algorithm: Algorithm, source: Source) -> Callable[[Carry, Int[Array, ""]], Rollout]:
    """One iteration's rollout of one seed, collected without learning from it."""
    page = page_length(algorithm, source.spec.num_envs)

    def one(carry: Carry, iteration: Int[Array, ""]) -> Rollout:
        noise = source.draw(page_keys(carry.loop_key, iteration // page).draw, page)
        now = jax.tree.map(lambda x: x[iteration % page], noise)
        return source.collect(carry.source, algorithm.actor(carry.learner), now)[1]

    return one


def _inspector(algorithm: Algorithm, source: Source, devices: int) -> Callable[[Carry, int], Rollout]:
    again = _collected_again(algorithm, source)
    collect = jax.jit(over_devices(lambda carry, iteration: over_seeds(lambda one: again(one, iteration))(carry), devices))
    return lambda carry, iteration: collect(placed(carry, devices), np.int32(iteration))


def _dynamics(algorithm: Algorithm, source: Source, latest: Latest, spent: Stopwatch, devices: int) -> Callable[[Carry, int], Metrics]:
    """One small program, compiled when it is first asked for.

    Learners without a replay are shown the rollout they learn from next or, of a host engine, which cannot make it twice, the last one.
    """
    again, look = _collected_again(algorithm, source), cast(Callable[[PyTree, PyTree], Metrics], algorithm.dynamics)
    shown = algorithm.needs.on_policy or source.spec.engine == "dataset"
    collects = source.compiled and shown

    def one(carry: Carry, rollout: PyTree, iteration: Int[Array, ""]) -> Metrics:
        return look(carry.learner, again(carry, iteration) if collects else rollout)

    def all_seeds(carry: Carry, rollout: PyTree, iteration: Int[Array, ""]) -> Metrics:
        return over_seeds(lambda carry, rollout: one(carry, rollout, iteration))(carry, rollout)

    traced = jax.jit(over_devices(all_seeds, devices))
    programs: list[Callable] = []

    def run(carry: Carry, iteration: int) -> Metrics:
        seen = latest.rollout if shown and not source.compiled else ()
        arguments = placed(carry, devices) if source.compiled else carry._replace(source=()), seen, np.int32(iteration)
        if not programs:
            spent.start()
            programs.append(compile_segment(traced.lower(*arguments)))
            spent.stop()
        return programs[0](*arguments)

    return run


def _compiled_segment(
    devices: int, algorithm: Algorithm, source: Source, learn: Callable, spent: Stopwatch
) -> Callable[[Carry, int, int], tuple[Carry, Report]]:
    """Iterations scanned page by page: the random numbers of a page are drawn at once, outside the inner loop.

    Pages lie at fixed iterations, so the numbers of an iteration do not depend on how segments are cut. The number of iterations is an
    argument of the compiled program, not part of it: every segment runs the same trace.
    """
    page = page_length(algorithm, source.spec.num_envs)

    # Jitted so that it is traced once, for the shapes of the report and for the loop alike.
    @jax.jit
    def iteration(carry: Carry, noise: PyTree, key: Key[Array, ""]) -> tuple[Carry, Report]:
        state, rollout, episodes = source.collect(carry.source, algorithm.actor(carry.learner), noise)
        learner, metrics = learn(carry.learner, rollout, key)
        return Carry(learner, state, carry.loop_key), Report(metrics, episodes)

    def segment(carry: Carry, first: Int[Array, ""], count: Int[Array, ""]) -> tuple[Carry, Report]:
        loop_key = carry.loop_key

        def one_page(number: Int[Array, ""], totals: tuple[Carry, Report]) -> tuple[Carry, Report]:
            keys = page_keys(loop_key, number)
            noise = source.draw(keys.draw, page)

            def one(i: Int[Array, ""], totals: tuple[Carry, Report]) -> tuple[Carry, Report]:
                carry, report = totals
                now = jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, i, keepdims=False), noise)
                carry, latest = iteration(carry, now, jax.random.fold_in(keys.update, i))
                return carry, jax.tree.map(jnp.add, report, latest)

            start = number * page
            return jax.lax.fori_loop(jnp.maximum(first - start, 0), jnp.minimum(first + count - start, page), one, totals)

        def report_of(carry: Carry, key: Key[Array, ""]) -> Report:
            return iteration(carry, jax.tree.map(lambda x: x[0], source.draw(key, 1)), key)[1]

        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(report_of, carry, loop_key))
        carry, report = jax.lax.fori_loop(first // page, -(-(first + count) // page), one_page, (carry, empty))
        return carry, report._replace(metrics=jax.tree.map(lambda total: total / count, report.metrics))

    def all_seeds(carry: Carry, first: Int[Array, ""], count: Int[Array, ""]) -> tuple[Carry, Report]:
        return over_seeds(lambda one: segment(one, first, count))(carry)

    traced = jax.jit(over_devices(all_seeds, devices), donate_argnums=0)
    programs: list[Callable] = []

    def run(carry: Carry, first: int, count: int) -> tuple[Carry, Report]:
        carry, numbers = placed(carry, devices), (np.int32(first), np.int32(count))
        if not programs:
            spent.start()
            programs.append(compile_segment(traced.lower(carry, *numbers)))
            spent.stop()
        return programs[0](carry, *numbers)

    return run
