"""What a look at learning dynamics costs beside an iteration of learning: ``python benchmarks/learning_dynamics.py ppo`` (or ``dqn``).

Prints CPU-milliseconds of an iteration and of a look, and what share of the task's iterations the nineteen looks of a run take.
"""

import argparse
import time
from collections.abc import Callable

import jax

from thorndike_rate import JOBS

ITERATIONS, LOOKS, LOOKS_OF_A_RUN = 1_000, 200, 19


def cpu_ms(times: int, work: Callable[[], object]) -> float:
    """CPU-milliseconds each of what ``work`` does ``times`` times."""
    began = time.process_time()
    jax.block_until_ready(work())
    return 1e3 * (time.process_time() - began) / times


def main() -> None:
    """Measure the task named on the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=("ppo", "dqn"))
    job = JOBS[parser.parse_args().task]
    from thorndike.api.building import build_algorithm
    from thorndike.environments.native import factory
    from thorndike.environments.native.vectorize import vectorize
    from thorndike.environments.wrappers import chain
    from thorndike.training.runner import runner
    from thorndike.training.sources import compiled_source

    environment = vectorize(factory(job.environment)(), job.num_envs or 1)
    algorithm = build_algorithm(job.algorithm, {**job.settings, "total_steps": job.steps}, environment.spec, None)
    agent = runner(algorithm, compiled_source(environment, algorithm, chain()), 0, [0])
    # What is compiled is compiled before the clock runs.
    carry, done = agent.init(), 2 * ITERATIONS
    carry, _ = agent.advance(carry, 0, done)
    jax.block_until_ready(agent.dynamics(carry, done))
    look = cpu_ms(LOOKS, lambda: [agent.dynamics(carry, done) for _ in range(LOOKS)])
    iteration = cpu_ms(ITERATIONS, lambda: agent.advance(carry, done, ITERATIONS))
    share = LOOKS_OF_A_RUN * look / (job.steps / agent.steps_per_iteration * iteration)
    print(f"an iteration {iteration:.3f} CPU-ms, a look {look:.3f} CPU-ms, {LOOKS_OF_A_RUN} looks {100 * share:.2f} % of the iterations")


if __name__ == "__main__":
    main()
