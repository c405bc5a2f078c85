"""``thorndike sweep ALGORITHM ENVIRONMENT --over NAME=VALUES``: search settings, say which matter, run the best again on fresh seeds."""

import shlex
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.answer import Answer
from thorndike.cli.environment_names import check_environment
from thorndike.cli.find_run import add_output_argument
from thorndike.cli.parser import Parser, positive_whole
from thorndike.cli.tables import table, text_of
from thorndike.cli.train import add_training_arguments, check_output, check_preset, given_env_kwargs, given_settings, named_algorithm, names
from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.learning_sources import check_source
from thorndike.plotting.style import check_plot_file
from thorndike.training.sweep_directory import find_sweep, read_sweep
from thorndike.training.sweep_ranges import SEARCHES, chosen_search, over_texts, swept_settings
from thorndike.training.sweep_search import check_search

if TYPE_CHECKING:
    from rich.console import RenderableType

    from thorndike.api import Sweep
    from thorndike.statistics.sweeps import Effect

EXAMPLES = """\
  thorndike sweep ppo CartPole-v1 --over learning_rate=1e-4,3e-4,1e-3 --over gamma=0.98,0.99 --seeds 5
  thorndike sweep ppo LunarLander-v3 --over 'learning_rate=log(1e-5,1e-2)' --over n_epochs=4,10 --trials 24
  thorndike sweep dqn CartPole-v1 --over 'learning_rate=log(1e-5,1e-2)' --trials 40 --search optuna
  thorndike sweep --resume latest"""

SHOWN = 10
"""Trials in the table that people read; all are in trials.jsonl."""


def run(words: Sequence[str]) -> Answer:
    """Sweep, and say which settings won, what they are worth, and which mattered."""
    options, given = _parse(words)
    if options.plot is not None:
        check_plot_file(options.plot)
    found = _resumed(options, given) if options.resume is not None else _swept(options, words)
    if options.plot is not None:
        found.plot(options.plot)
    return Answer(_data(found), _drawn(found, options.plot))


def _parse(words: Sequence[str]) -> tuple[Namespace, list[str]]:
    """The options, and the names of those that were given."""
    parser = Parser("sweep", "Search settings: a grid, random trials or Optuna, all seeds in few compiled programs.", EXAMPLES)
    algorithm = named_algorithm(words)
    add_training_arguments(parser, read_config_fields(algorithm) if algorithm in ALGORITHMS else {})
    parser.set_defaults(seeds=3)
    parser._option_string_actions["--seeds"].help = "agents of each trial (default: 3)"
    parser.add_argument(
        "--over",
        action="append",
        default=[],
        metavar="NAME=VALUES",
        help="a setting and what is tried of it: a,b,c (of lists: 64,64;256,256), uniform(LOW,HIGH) or log(LOW,HIGH); may be repeated",
    )
    parser.add_argument("--trials", type=positive_whole, help="random trials (default: the whole grid; with a range 20)")
    parser.add_argument("--search", choices=SEARCHES, default="auto", help="how trials are chosen (default: grid of lists, else random)")
    parser.add_argument("--episodes", type=positive_whole, default=20, help="episodes that score each seed (default: 20)")
    parser.add_argument("--fresh-seeds", type=positive_whole, default=10, help="seeds on which the best is run again (default: 10)")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="draw the response curves there too")
    parser.add_argument("--resume", metavar="SWEEP", help="go on with an interrupted sweep: its directory, a part of its name, or latest")
    parser.add_argument("--name", help="the last part of the sweep's directory's name")
    add_output_argument(parser)
    options = parser.parse(words)
    return options, [name for name, value in vars(options).items() if value != parser.get_default(name)]


def _swept(options: Namespace, words: Sequence[str]) -> "Sweep":
    algorithm, environment = names(options)
    if algorithm == "planning":
        raise UserError("planning learns nothing, so there is nothing to sweep: it computes exact values; sweep q_learning instead")
    settings, env_kwargs = given_settings(options, algorithm), given_env_kwargs(options.env_set)
    over = over_texts(options.over)
    swept = swept_settings(over, read_config_fields(algorithm), algorithm, settings)
    check_search(chosen_search(swept, options.search, options.trials))
    check_source(algorithm, environment)
    check_environment(
        environment,
        engine=options.engine,
        env_kwargs=env_kwargs,
        max_episode_steps=options.max_episode_steps,
        algorithm=algorithm,
    )
    check_preset(algorithm, environment, options.preset)
    check_output(options.output)
    from thorndike.api import sweep

    return sweep(
        algorithm,
        environment,
        over=over,
        trials=options.trials,
        search=options.search,
        seeds=options.seeds,
        steps=options.steps,
        seed=options.seed,
        num_envs=options.num_envs,
        settings=settings,
        preset=options.preset,
        engine=options.engine,
        device=options.device,
        episodes=options.episodes,
        fresh_seeds=options.fresh_seeds,
        output=options.output,
        name=options.name,
        max_episode_steps=options.max_episode_steps,
        env_kwargs=env_kwargs,
        progress=not options.json,
        command=shlex.join(["thorndike", "sweep", *words]),
    )


def _resumed(options: Namespace, given: Sequence[str]) -> "Sweep":
    """Everything is read from ``sweep.json``, so nothing else may be given."""
    others = [name for name in given if name not in ("resume", "output", "plot", "json")]
    if others:
        flag = others[0].removeprefix("setting ").replace("_", "-")
        shown = flag if flag in ("algorithm", "environment") else f"--{flag}"
        raise UserError(f"--resume goes on with what the sweep was asked for, which cannot be changed: leave {shown} out")
    path = find_sweep(options.resume, options.output)
    read_sweep(path)
    from thorndike.api import resume_sweep

    return resume_sweep(path, progress=not options.json)


def _data(found: "Sweep") -> dict[str, object]:
    winner, fresh = found.winner, found.winner.fresh
    return {
        "sweep": found.path,
        "algorithm": found.algorithm,
        "environment": found.environment,
        "search": found.search,
        "trials": [
            {"trial": row.trial, "settings": row.settings, "mean": row.mean, "scores": row.scores, "failures": row.failures}
            for row in found.trials
        ],
        "effects": [{**effect._asdict(), "points": [point._asdict() for point in effect.points]} for effect in found.effects],
        "winner": {
            "trial": winner.trial,
            "settings": winner.settings,
            "mean_in_sweep": winner.mean,
            "run": winner.run,
            "seed": winner.seed,
            "fresh_mean": fresh.mean,
            "fresh_ci95": fresh.ci95,
            "fresh_per_seed": fresh.per_seed,
        },
    }


def _drawn(found: "Sweep", plot: Path | None) -> "RenderableType":
    from rich.console import Group
    from rich.markup import escape

    ranked = sorted(found.trials, key=lambda row: (-row.mean if row.mean == row.mean else float("inf"), row.trial))
    rows: list[dict[str, object]] = []
    for row in ranked[:SHOWN]:
        failed = sum(score is None for score in row.scores)
        told = {name: text_of(value) for name, value in row.settings.items()}
        rows.append(
            {"trial": row.trial, **told, "mean": float(f"{row.mean:.4g}"), "seeds": ", ".join(map(_score, row.scores)), "failed": failed}
        )
    if not any(row["failed"] for row in rows):
        rows = [{name: value for name, value in row.items() if name != "failed"} for row in rows]
    more = [f"... and {len(ranked) - SHOWN} more in {found.path / 'trials.jsonl'}"] if len(ranked) > SHOWN else []
    lines = [*more, "", *map(_effect, found.effects), "", *_winner(found), *([f"plot: {shlex.quote(str(plot))}"] if plot else [])]
    return Group(table(rows), *map(escape, lines))


def _score(score: float | None) -> str:
    return "failed" if score is None else f"{score:.4g}"


def _effect(effect: "Effect") -> str:
    """The verdict on one setting in a sentence."""
    low, high = effect.ci95
    evidence = f"its values' means lie {effect.effect:.4g} apart (95 % interval {low:.4g} to {high:.4g}"
    tested = f", p = {effect.p_value:.2g})" if effect.p_value == effect.p_value else ")"
    match effect.verdict:
        case "matters":
            best = max(effect.points, key=lambda point: point.mean)
            return f"{effect.name} matters: best around {' to '.join(map(text_of, best.values))}; {evidence}{tested}"
        case "does not matter here":
            return f"{effect.name} does not matter here: {evidence}{tested}"
    return f"{effect.name}: cannot tell (more seeds or trials would): {evidence}{tested}"


def _winner(found: "Sweep") -> list[str]:
    winner, fresh = found.winner, found.winner.fresh
    low, high = fresh.ci95
    told = ", ".join(f"{name}={text_of(value)}" for name, value in winner.settings.items())
    return [
        f"best of {len(found.trials)} trials: {told}",
        f"in the sweep {winner.mean:.4g}, which is optimistic: it won because it was the best of {len(found.trials)}",
        f"on {len(fresh.per_seed)} fresh seeds (seed {winner.seed}): {fresh.mean:.4g} (95 % interval {low:.4g} to {high:.4g})",
        f"run: {winner.run}",
        f"sweep: {found.path}",
    ]
