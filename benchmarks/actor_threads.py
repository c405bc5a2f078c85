"""Acting and learning side by side: IMPALA with and without actor threads, on an environment that waits a millisecond a step.

python benchmarks/actor_threads.py [--wait 0.001] [--steps 6000] [--rounds 3]

A row is the fastest of the rounds, in which the runs take turns in this process. `stepping` is the share of the wall time in which at
least one environment is in its step: what is missing to 100 % is time in which all of them stand still, because an actor decides or the
learner learns. A fixed schedule, IMPALA's defaults, one environment a thread.
"""

import argparse
import tempfile
import time
from typing import ClassVar

import gymnasium
import numpy as np

import thorndike as td

THREADS = (0, 1, 2, 4)
SETTINGS = {"policy_lag": 0}


class Waiting(gymnasium.Wrapper):
    """CartPole whose every step waits, as one that runs elsewhere does."""

    spans: ClassVar[list[tuple[float, float]]] = []
    """When each step began and ended."""

    def __init__(self, wait: float) -> None:
        """`wait` seconds."""
        super().__init__(gymnasium.make("CartPole-v1"))
        self._wait = wait

    def step(self, action: np.ndarray) -> tuple:
        """The step, later."""
        began = time.perf_counter()
        time.sleep(self._wait)
        outcome = super().step(action)
        Waiting.spans.append((began, time.perf_counter()))
        return outcome


def waiting_cartpole(wait: float) -> gymnasium.Env:
    """One of them."""
    return Waiting(wait)


def stepping() -> tuple[float, float]:
    """Seconds from the first step to the end of the last, and those in which at least one environment was in its step."""
    spans = sorted(Waiting.spans)
    covered, reached = 0.0, spans[0][0]
    for began, ended in spans:
        covered += max(0.0, ended - max(began, reached))
        reached = max(reached, ended)
    return reached - spans[0][0], covered


def measure(wait: float, steps: int, threads: int) -> tuple[float, float]:
    """The same of a run."""
    Waiting.spans.clear()
    with tempfile.TemporaryDirectory() as folder:
        td.train(
            "impala", waiting_cartpole, env_kwargs={"wait": wait}, engine="gymnasium", num_envs=1, steps=steps, checkpoint_every=steps,
            settings=SETTINGS, output=folder, actor_threads=threads, progress=False,
        )  # fmt: skip
    # The first tenth compiles.
    del Waiting.spans[: steps // 10]
    return stepping()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--wait", type=float, default=0.001, help="seconds that a step waits")
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    best: dict[int, tuple[float, float]] = {}
    for _ in range(options.rounds):
        for threads in THREADS:
            best[threads] = min(best.get(threads, (np.inf, 0.0)), measure(options.wait, options.steps, threads))
    print("| actor threads | wall, s | steps/s | stepping |")
    print("|---|---|---|---|")
    for threads, (wall, covered) in best.items():
        print(f"| {threads} | {wall:.2f} | {0.9 * options.steps / wall:,.0f} | {100 * covered / wall:.0f} % |")


if __name__ == "__main__":
    main()
