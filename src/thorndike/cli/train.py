"""``thorndike train ALGORITHM ENVIRONMENT``: everything that can be wrong is looked at before JAX is imported."""

import ast
import errno
import math
import os
import shlex
from argparse import SUPPRESS, Namespace
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.answer import Answer
from thorndike.cli.environment_names import check_environment
from thorndike.cli.find_run import add_output_argument, exists, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.config_fields import read_config_fields
from thorndike.environments.wrapper_names import parse_wrapper
from thorndike.errors import UserError
from thorndike.learning_sources import check_source, is_dataset
from thorndike.settings import FieldFacts, parse_settings
from thorndike.suggestions import did_you_mean

if TYPE_CHECKING:
    from thorndike.api import Result

ENGINES = ("auto", "native", "gymnasium", "subprocess", "envpool", "ale")
DEVICES = ("auto", "cpu", "gpu")

EXAMPLES = """\
  thorndike train ppo CartPole-v1 --seeds 8
  thorndike train dqn LunarLander-v3 --steps 300k --set 'learning_rate=linear(1e-3,0)'
  thorndike train ppo HalfCheetah-v5 --engine envpool --num-envs 8 --name first-try
  thorndike train q_learning FrozenLake-v1 --env-set is_slippery=False
  thorndike train ppo my_module:MyEnv-v0 --seeds 4 --json
  thorndike train ppo DeepSea-v0 --wrap random_network_distillation
  thorndike train ppo Pendulum-v1 --reward runs/swing
  thorndike train iql datasets/CartPole-v1/ppo-v0 --steps 20k

every setting of an algorithm (`thorndike list settings ppo`) may also stand as a flag: --learning-rate 1e-3"""

_SETTING = "setting "


def run(words: Sequence[str]) -> Answer:
    """Train, and say where the run is and how it went."""
    options = _parse(words)
    algorithm, environment = names(options)
    settings, env_kwargs = given_settings(options, algorithm), given_env_kwargs(options.env_set)
    # Before the environment, for which JAX is imported if it has a table.
    check_output(options.output)
    check_source(algorithm, environment)
    if not is_dataset(environment):
        check_environment(
            environment,
            engine=options.engine,
            env_kwargs=env_kwargs,
            max_episode_steps=options.max_episode_steps,
            algorithm=algorithm,
        )
        check_preset(algorithm, environment, options.preset)
    check_reward(options.reward)
    start_from = None if options.start_from is None else find_run(options.start_from, options.output)
    wrapper_settings = [parse_wrapper(text) for text in options.wrap]
    from thorndike.api import train
    from thorndike.environments.wrappers import build_wrapper

    result = train(
        algorithm,
        environment,
        steps=options.steps,
        seeds=options.seeds,
        seed=options.seed,
        num_envs=options.num_envs,
        settings=settings,
        preset=options.preset,
        engine=options.engine,
        device=options.device,
        devices=options.devices,
        output=options.output,
        name=options.name,
        checkpoint_every=options.checkpoint_every,
        keep_checkpoints=options.keep_checkpoints,
        max_episode_steps=options.max_episode_steps,
        env_kwargs=env_kwargs,
        actor_threads=options.actor_threads,
        actor_schedule=options.actor_schedule,
        env_restarts=options.env_restarts,
        wrappers=[build_wrapper(each) for each in wrapper_settings] or None,
        start_from=start_from,
        reward=options.reward,
        progress=not options.json,
        command=shlex.join(["thorndike", "train", *words]),
    )
    return trained(result)


def add_training_arguments(parser: Parser, fields: Mapping[str, FieldFacts], datasets: bool = False) -> None:
    """The arguments that say what is trained; `train`, `bench` and `sweep` share them. Only `train` takes ``datasets``."""
    parser.add_argument("algorithm", nargs="?", metavar="ALGORITHM", help=f"one of {', '.join(ALGORITHMS)}")
    parser.add_argument(
        "environment",
        nargs="?",
        metavar="ENVIRONMENT",
        help="a Gymnasium id, module:Id, or path/to/file.py:ClassName" + (", or a dataset's folder" if datasets else ""),
    )
    _add_old_hands_flags(parser)
    parser.add_argument("--steps", type=positive_whole, help="environment steps of each seed: 50000, 50k, 1e6")
    parser.add_argument("--seeds", type=positive_whole, default=1, help="independent agents trained at once (default: 1)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    parser.add_argument("--num-envs", type=positive_whole, help="environments of each seed, stepped together")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="a setting of the algorithm; may be repeated"
    )
    parser.add_argument(
        "--env-set", action="append", default=[], metavar="NAME=VALUE", help="an argument of the environment; may be repeated"
    )
    parser.add_argument("--max-episode-steps", type=positive_whole, metavar="STEPS", help="a time limit instead of the environment's own")
    parser.add_argument(
        "--preset", metavar="NAME", help="measured settings, or none (default: the environment's; `thorndike list presets`)"
    )
    parser.add_argument("--engine", choices=ENGINES, default="auto", help="what steps the environment (default: the fastest that can)")
    parser.add_argument("--device", choices=DEVICES, default="auto", help="where learning is computed (default: chosen by size)")
    taken = set(parser._option_string_actions)
    for name in fields:
        flag = "--" + name.replace("_", "-")
        if flag not in taken:
            parser.add_argument(flag, metavar="VALUE", dest=_SETTING + name, help=SUPPRESS)


def add_devices_argument(parser: Parser) -> None:
    """`--devices`; `train` and `bench` have it."""
    parser.add_argument(
        "--devices", type=positive_whole, metavar="N", help="how many devices (a CPU's cores) share the seeds at most (default: all)"
    )


def _add_old_hands_flags(parser: Parser) -> None:
    """What the users of Stable-Baselines3, RL Zoo and CleanRL type without thinking."""
    parser.add_argument("--algo", help=SUPPRESS)
    parser.add_argument("--env", "--env-id", help=SUPPRESS)
    parser.add_argument("-n", "--total-timesteps", "--n-timesteps", "--total-steps", dest="steps", type=positive_whole, help=SUPPRESS)
    parser.add_argument("--n-envs", dest="num_envs", type=positive_whole, help=SUPPRESS)


def named_algorithm(words: Sequence[str]) -> str | None:
    """The algorithm the words ask for, before they are parsed: its settings are flags too."""
    for flag, value in zip(words, [*words, ""][1:], strict=True):
        if flag == "--algo":
            return value
        if flag.startswith("--algo="):
            return flag.partition("=")[2]
    places = (word for before, word in zip(["", *words], words, strict=False) if before not in _FREE_TEXT)
    return next((word for word in places if word in ALGORITHMS), None)


_FREE_TEXT = ("--name", "--output", "--env")
"""Flags whose value may be an algorithm's name without meaning it."""


def names(options: Namespace) -> tuple[str, str]:
    """Algorithm and environment, each given by its place or by its flag. Raises UserError if one is missing or unknown."""
    places = [word for word in (options.algorithm, options.environment) if word is not None]
    algorithm = options.algo if options.algo is not None else places.pop(0) if places else None
    environment = options.env if options.env is not None else places.pop(0) if places else None
    if algorithm is None:
        raise UserError(f"which algorithm? One of {', '.join(ALGORITHMS)}, as in: thorndike train ppo CartPole-v1")
    if algorithm not in ALGORITHMS:
        turned = f"; the algorithm comes first: thorndike train {environment} {algorithm}" if environment in ALGORITHMS else ""
        raise UserError(f"there is no algorithm '{algorithm}'{turned or did_you_mean(algorithm, ALGORITHMS)}")
    if environment is None:
        raise UserError(f"which environment? Name one, as in: thorndike train {algorithm} CartPole-v1")
    if places:
        raise UserError(f"did not expect '{places[0]}' beside the algorithm '{algorithm}' and the environment '{environment}'")
    return algorithm, environment


def given_settings(options: Namespace, algorithm: str) -> dict[str, object]:
    """The settings of ``--set`` and of flags such as ``--learning-rate``, checked. Raises UserError."""
    as_flags = [f"{key.removeprefix(_SETTING)}={value}" for key, value in vars(options).items() if key.startswith(_SETTING) and value]
    known = read_config_fields(algorithm)
    settings = parse_settings([*options.settings, *as_flags], known, algorithm)
    if "total_steps" in settings:
        raise UserError("the number of steps is given by --steps, not by --set total_steps")
    return settings


def given_env_kwargs(texts: Iterable[str]) -> dict[str, object]:
    """``["is_slippery=False", "map_name=8x8"]`` as keyword arguments: Python literals, or else text. Raises UserError."""
    values: dict[str, object] = {}
    for text in texts:
        name, equals, value = text.replace(":", "=", 1).partition("=") if "=" not in text else text.partition("=")
        if not equals or not name.isidentifier():
            raise UserError(f"--env-set {text}: expected NAME=VALUE, for example --env-set is_slippery=False")
        values[name] = _literal(value)
    return values


def check_preset(algorithm: str, environment: str, preset: str | None) -> None:
    """Raises UserError if the environment has no preset of this name."""
    if preset is not None:
        from thorndike.training.presets import find_preset

        find_preset(algorithm, environment, preset)


def trained(result: "Result") -> Answer:
    """The answer of `train` and `resume`."""
    data = {
        "run": result.run,
        "status": result.status,
        "steps": result.steps,
        "seeds": result.seeds,
        "wall_s": result.wall_s,
        "cpu_s": result.cpu_s,
        "compile_s": result.compile_s,
        "steps_per_s": result.steps_per_s,
        "steps_per_cpu_s": result.steps_per_cpu_s,
    }
    plan = result.run / "plan.txt"
    if plan.exists():
        return Answer(data, _planned(result, plan.read_text(encoding="utf-8")))
    verb = "resume" if result.status == "interrupted" else "eval"
    seeds = "one seed" if result.seeds == 1 else f"each of {result.seeds} seeds"
    text = (
        f"{result.status}: {result.steps:,} steps of {seeds} in {result.wall_s:.1f} s ({result.cpu_s:.1f} CPU-s, "
        f"of which {result.compile_s:.1f} compiling): {result.steps_per_s:,.0f} steps/s\n"
        f"{_last_return(result.mean_return)}\n"
        f"run: {result.run}\n"
        f"next: thorndike {verb} {shlex.quote(str(result.run))}"
    )
    return Answer(data, text, exit_status=128 + result.signal if result.signal else 0)


def _planned(result: "Result", picture: str) -> str:
    return (
        f"{picture}\nplanned in {result.steps:,} sweeps, {result.wall_s:.2f} s; value of the start: {result.mean_return:.6f}\n"
        f"run: {result.run}\nnext: thorndike eval {shlex.quote(str(result.run))}"
    )


def _last_return(mean_return: float) -> str:
    return "no training episode has ended yet" if math.isnan(mean_return) else f"mean training return at the end: {mean_return:.4g}"


def _parse(words: Sequence[str]) -> Namespace:
    parser = Parser("train", "Train an agent, or several independent seeds of it in one compiled program.", EXAMPLES)
    algorithm = named_algorithm(words)
    add_training_arguments(parser, read_config_fields(algorithm) if algorithm in ALGORITHMS else {}, datasets=True)
    add_output_argument(parser)
    add_devices_argument(parser)
    parser.add_argument(
        "--wrap",
        action="append",
        default=[],
        metavar="WRAPPER",
        help="a wrapper in place of the preset's, as in 'count_bonus(coefficient=0.1)'; may be repeated, the first nearest the environment",
    )
    parser.add_argument(
        "--reward", type=Path, metavar="DIR", help="a folder of clips; the reward learnt in it (thorndike clips) is what is trained on"
    )
    parser.add_argument("--start-from", metavar="RUN", help="a run of the same algorithm on a dataset, to go on from online (awac)")
    parser.add_argument("--name", help="the last part of the run directory's name")
    parser.add_argument("--checkpoint-every", type=positive_whole, metavar="STEPS", help="steps between two checkpoints")
    keep_help = "how many of the newest stay, 2 or more, for a match between them (default: 2)"
    parser.add_argument("--keep-checkpoints", type=positive_whole, default=2, metavar="N", help=keep_help)
    parser.add_argument(
        "--actor-threads", type=positive_whole, default=0, metavar="N", help="threads that step host environments while the learner learns"
    )
    parser.add_argument(
        "--actor-schedule", choices=("fixed", "free"), default="fixed", help="take their rollouts in turn, or as they come (default: fixed)"
    )
    parser.add_argument(
        "--env-restarts", type=positive_whole, default=0, metavar="N", help="faults after which a thread's environments are made anew"
    )
    return parser.parse(words)


def check_reward(folder: Path | None) -> None:
    """Raises UserError if there is no learnt reward."""
    if folder is not None and not ((folder / "reward.json").is_file() or (folder / "clips.json").is_file()):
        raise UserError(f"--reward {folder} holds no learnt reward: give a folder of clips in which thorndike clips fit has made one")


def check_output(output: Path) -> None:
    """Raises UserError if no folder can be made there."""
    try:
        os.lstat(output)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise UserError(f"--output {output}: no folder can have so long a name; choose another") from None
    nearest = next(folder for folder in (output.absolute(), *output.absolute().parents) if exists(folder))
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        what = "is not a folder" if not nearest.is_dir() else "may not be written to"
        raise UserError(f"--output {output}: {nearest} {what}; choose another folder")


def _literal(text: str) -> object:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        # All that Python's reader raises for what is no literal: the last two for what is nested too deeply, TypeError for `{[]: 1}`.
        return text
