"""A segment: what goes in, what comes out, and what compiled and host loops share."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.training.time_shares import Shares
from thorndike.types import Algorithm, EpisodeStats, Rollout

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


class PageKeys(NamedTuple):
    """What the random numbers of a page follow from."""

    draw: Key[Array, ""]
    update: Key[Array, ""]


def page_keys(loop_key: Key[Array, ""], number: Int[Array, ""]) -> PageKeys:
    """Of page ``number``."""
    return PageKeys(*jax.random.split(jax.random.fold_in(loop_key, number)))
