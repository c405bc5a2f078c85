"""The one runner: every algorithm, every source, every number of seeds.

An iteration is ``collect`` then ``update``. Iterations are scanned into a *segment*, one compiled program for all seeds, with its carry
donated. Between segments the host logs, evaluates and saves. The random numbers of iteration ``i`` follow from
``fold_in(run key, page of i)``, so how iterations are grouped into segments changes nothing.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree, UInt32

from thorndike.training.devices import over_devices, placed
from thorndike.training.host_source import HostSource
from thorndike.training.time_shares import Clock, SegmentTimes, Shares
from thorndike.types import Algorithm, EpisodeStats, Metrics, Rollout, Source

_ROWS_OF_A_PAGE = 1_024
RUN_ONCE = {"xla_backend_optimization_level": 0}
"""For programs that run once: compiling them costs more than running them (measured: 1.2 s in place of 5.3 s)."""
_CALLS_KERNELS: dict[str, str | bool] = {"xla_backend_optimization_level": "1", "xla_cpu_parallel_codegen_split_count": "1"}
_ONE_FUNCTION: dict[str, str | bool] = {"xla_cpu_parallel_codegen_split_count": "1"}


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
    loop_key: Key[Array, " S"]
    """What all random numbers of the loop follow from; it never changes."""


class Report(NamedTuple):
    """What a segment tells, a number a seed: means over its iterations and sums over its episodes."""

    metrics: dict[str, Float[Array, " S"]]
    episodes: EpisodeStats
    shares: Shares | None = None
    """Where the time of a segment on a host engine went; a compiled one is a single program."""


class Latest:
    """Holds a host engine's latest rollout ``[S, T, B, ...]``, once there is one."""

    rollout: Rollout


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
    make = partial(_compiled_segment, devices) if plain.compiled else partial(_host_segment, clock=clock, latest=latest)
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


def over_seeds(function: Callable) -> Callable:
    """``function`` of one seed, applied to arguments that lead with the seed axis, in one program.

    Vmapped on an accelerator. On a CPU the seeds take turns inside the program: batched matrix products and gathers are slower there than
    one after another (measured with 10 seeds: DQN 1.2x, PPO 1.05x, with 64 Q-learning 1.6x), it compiles faster, and an agent's bits do not
    depend on how many it trains beside.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *arguments: jax.lax.map(lambda each: function(*each), arguments)


def compile_segment(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Compile with what was measured to be best on a CPU; elsewhere as it is.

    A program with matrix products is a sequence of kernels: optimised less it compiles in 15 % fewer CPU-seconds and runs as fast (PPO,
    DQN). One without, a table's, is a single function, which would run 15 % slower.
    """
    if jax.default_backend() != "cpu":
        return lowered.compile()
    return lowered.compile(_CALLS_KERNELS if "dot_general" in lowered.as_text() else _ONE_FUNCTION)


def page_length(algorithm: Algorithm, num_envs: int) -> int:
    """Iterations whose random numbers are drawn together. Segments that are multiples of it draw nothing in vain."""
    return max(1, _ROWS_OF_A_PAGE // (algorithm.needs.rollout_length * num_envs))


class _PageKeys(NamedTuple):
    draw: Key[Array, ""]
    update: Key[Array, ""]


def _page_keys(loop_key: Key[Array, ""], number: Int[Array, ""]) -> _PageKeys:
    return _PageKeys(*jax.random.split(jax.random.fold_in(loop_key, number)))


def _collected_again(algorithm: Algorithm, source: Source) -> Callable[[Carry, Int[Array, ""]], Rollout]:
    """One iteration's rollout of one seed, collected without learning from it."""
    page = page_length(algorithm, source.spec.num_envs)

    def one(carry: Carry, iteration: Int[Array, ""]) -> Rollout:
        noise = source.draw(_page_keys(carry.loop_key, iteration // page).draw, page)
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
            keys = _page_keys(loop_key, number)
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


class _Learners(NamedTuple):
    """How the learners of all seeds are held while a host engine steps."""

    take: Callable[[PyTree], PyTree]
    """learners as a carry has them -> as they are held."""
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
        return jax.tree.map(lambda x: x[None], learn(*jax.tree.map(lambda x: x.reshape(x.shape[1:]), arguments)))

    return _stacked(algorithm, learn)._replace(learn=jax.jit(one, donate_argnums=0))


def _apart(algorithm: Algorithm, learn: Callable) -> _Learners:
    """A learner a seed. XLA would copy the replay out of a stack and into it again at every iteration (SAC with 1,000,000 transitions)."""
    actor = jax.jit(algorithm.actor)
    learn_one = jax.jit(lambda learner, rollout, keys, i: learn(learner, jax.tree.map(lambda x: x[i], rollout), keys[i]), donate_argnums=0)
    stack = jax.jit(lambda trees: jax.tree.map(lambda *rows: jnp.stack(rows), *trees))

    def take(learner: PyTree) -> PyTree:
        seeds = jax.tree.leaves(learner)[0].shape[0]
        return [jax.tree.map(lambda x, i=i: x[i], learner) for i in range(seeds)]

    def learn_each(held: PyTree, rollout: Rollout, keys: Key[Array, " S"]) -> tuple[PyTree, Metrics]:
        outcomes = [learn_one(learner, rollout, keys, np.int32(i)) for i, learner in enumerate(held)]
        return [learner for learner, _ in outcomes], stack([metrics for _, metrics in outcomes])

    return _Learners(take, lambda held: stack([actor(learner) for learner in held]), learn_each, stack)


def _host_segment(
    algorithm: Algorithm, source: Source, learn: Callable, spent: Stopwatch, clock: Clock | None, latest: Latest
) -> Callable[[Carry, int, int], tuple[Carry, Report]]:
    """The same iterations, stepped from Python. ``latest`` is given the last rollout."""
    page = page_length(algorithm, source.spec.num_envs)
    on_cpu, replays = jax.default_backend() == "cpu", not algorithm.needs.on_policy
    stacked, alone, apart = (hold(algorithm, learn) for hold in (_stacked, _alone, _apart))

    def prepare(loop_key: Key[Array, ""], iteration: Int[Array, ""]) -> tuple[PyTree, Key[Array, ""]]:
        keys = _page_keys(loop_key, iteration // page)
        noise = jax.tree.map(lambda x: x[iteration % page], source.draw(keys.draw, page))
        return noise, jax.random.fold_in(keys.update, iteration % page)

    prepare_all = jax.jit(jax.vmap(prepare, in_axes=(0, None)))
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
            noise, keys = prepare_all(loop_keys, np.int32(iteration))
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
        metrics = jax.tree.map(lambda *rows: sum(rows) / len(rows), *[report.metrics for report in reports])
        episodes = jax.tree.map(lambda *rows: sum(rows), *[report.episodes for report in reports])
        return Carry(learners.give(held), state, loop_keys), Report(metrics, episodes, shares)

    return run
