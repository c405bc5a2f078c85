"""``thorndike bench ALGORITHM ENVIRONMENT``: how fast it is on this machine. `make bench` compares with other libraries."""

import statistics
import tempfile
from collections.abc import Sequence

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.answer import Answer
from thorndike.cli.environment_names import check_environment
from thorndike.cli.parser import Parser, positive_whole
from thorndike.cli.train import (
    add_devices_argument,
    add_training_arguments,
    check_preset,
    given_env_kwargs,
    given_settings,
    named_algorithm,
    names,
)
from thorndike.config_fields import read_config_fields
from thorndike.learning_sources import check_source

EXAMPLES = """\
  thorndike bench ppo CartPole-v1
  thorndike bench ppo CartPole-v1 --seeds 64 --steps 1M --repeat 5"""


def run(words: Sequence[str]) -> Answer:
    """Train a few times in a folder that is thrown away; the median speed."""
    parser = Parser("bench", "Measure steps per second on this machine, learning included, compilation apart.", EXAMPLES)
    algorithm = named_algorithm(words)
    add_training_arguments(parser, read_config_fields(algorithm) if algorithm in ALGORITHMS else {})
    add_devices_argument(parser)
    parser.add_argument("--repeat", type=positive_whole, default=3, help="runs to measure (default: 3)")
    options = parser.parse(words)
    algorithm, environment = names(options)
    settings, env_kwargs = given_settings(options, algorithm), given_env_kwargs(options.env_set)
    check_source(algorithm, environment)
    check_environment(
        environment,
        engine=options.engine,
        env_kwargs=env_kwargs,
        max_episode_steps=options.max_episode_steps,
        algorithm=algorithm,
    )
    check_preset(algorithm, environment, options.preset)
    from thorndike.api import train

    with tempfile.TemporaryDirectory(prefix="thorndike-bench-") as folder:
        results = [
            train(
                algorithm,
                environment,
                steps=options.steps,
                seeds=options.seeds,
                seed=options.seed + number,
                num_envs=options.num_envs,
                settings=settings,
                preset=options.preset,
                max_episode_steps=options.max_episode_steps,
                engine=options.engine,
                device=options.device,
                devices=options.devices,
                output=folder,
                env_kwargs=env_kwargs,
            )
            for number in range(options.repeat)
        ]
    data = {
        "algorithm": algorithm,
        "environment": environment,
        "steps": results[0].steps,
        "seeds": results[0].seeds,
        "repeats": options.repeat,
        "steps_per_s": statistics.median(result.steps_per_s for result in results),
        "steps_per_cpu_s": statistics.median(result.steps_per_cpu_s for result in results),
        "compile_s": results[0].compile_s,
    }
    text = (
        f"{algorithm} on {environment}, {data['steps']:,} steps x {data['seeds']} seeds, median of {options.repeat}:\n"
        f"{data['steps_per_s']:,.0f} steps/s, {data['steps_per_cpu_s']:,.0f} steps per CPU-second, compiling took {data['compile_s']:.1f} s"
    )
    return Answer(data, text)
