"""``thorndike clips train ALGORITHM ENVIRONMENT``: clips, choices, reward and training in rounds."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.answer import Answer
from thorndike.cli.clips.arguments import add_clip_arguments, add_rater_arguments, reward_settings, settings_in_words, to_label
from thorndike.cli.environment_names import check_environment
from thorndike.cli.parser import Parser, positive_whole
from thorndike.cli.train import (
    add_training_arguments,
    check_output,
    check_preset,
    given_env_kwargs,
    given_settings,
    named_algorithm,
    names,
    trained,
)
from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.learning_sources import check_source

if TYPE_CHECKING:
    from thorndike.api.clip_rounds import Rounds

CHOICES, ROUNDS = 500, 5
EXAMPLES = """\
  thorndike clips train ppo Pendulum-v1 --to runs/swing --choices 200 --question "Which stands up better?"
  thorndike clips train ppo Pendulum-v1 --to runs/try --simulate --error-rate 0.1
It stops where people must judge; the same command goes on. Settings of the reward, --reward-set:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """Go as far as it goes, and say what is next."""
    parser = Parser("clips train", "Train an agent from choices between clips, in rounds.", EXAMPLES.format(settings=settings_in_words()))
    algorithm = named_algorithm(words)
    parser.add_argument("--to", type=Path, required=True, metavar="DIR", help="the folder that keeps clips, choices, rewards and the run")
    parser.add_argument("--choices", type=positive_whole, default=CHOICES, metavar="N", help=f"in all (default: {CHOICES})")
    parser.add_argument(
        "--rounds", type=positive_whole, default=ROUNDS, metavar="N", help=f"of clips, reward and training (default: {ROUNDS})"
    )
    add_clip_arguments(parser)
    parser.add_argument("--simulate", action="store_true", help="a program judges by the environment's own reward; nothing is filmed")
    add_rater_arguments(parser, "--rater-temperature")
    parser.add_argument(
        "--reward-set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the reward's networks; may be repeated"
    )
    # After the others: a learner's settings are flags too, where they are not taken.
    add_training_arguments(parser, read_config_fields(algorithm) if algorithm in ALGORITHMS else {})
    options = parser.parse(words)
    algorithm, environment = names(options)
    settings, env_kwargs = given_settings(options, algorithm), given_env_kwargs(options.env_set)
    fit = reward_settings(options.reward_set)
    check_output(options.to)
    check_source(algorithm, environment)
    check_environment(
        environment, engine=options.engine, env_kwargs=env_kwargs, max_episode_steps=options.max_episode_steps, algorithm=algorithm
    )
    check_preset(algorithm, environment, options.preset)
    if not options.simulate and (options.temperature, options.error_rate) != (1.0, 0.0):
        raise UserError("--rater-temperature and --error-rate are of a program that judges: give --simulate, or leave them out")
    from thorndike.api.clip_rounds import QUESTION, SimulatedRater, train_on_choices

    found = train_on_choices(
        algorithm,
        environment,
        options.to,
        choices=options.choices,
        rounds=options.rounds,
        simulated=SimulatedRater(options.temperature, options.error_rate) if options.simulate else None,
        length=options.length,
        question=options.question or QUESTION,
        fit=fit,
        steps=options.steps,
        seeds=options.seeds,
        seed=options.seed,
        num_envs=options.num_envs,
        settings=settings,
        preset=options.preset,
        engine=options.engine,
        device=options.device,
        env_kwargs=env_kwargs,
        max_episode_steps=options.max_episode_steps,
        progress=not options.json,
        told=None if options.json else lambda line: print(line, file=sys.stderr, flush=True),
    )
    return _answer(found)


def _answer(found: "Rounds") -> Answer:
    data = {"status": found.status, "folder": found.folder, "round": found.round, "rounds": found.rounds, "left": found.left}
    data |= {"accuracy": found.accuracy, "run": found.run}
    if found.status == "waiting":
        text = f"round {found.round} of {found.rounds}: {found.left} pairs of clips wait for you\nnext: {to_label(found.folder)}"
        return Answer(data, f"{text}\nthen: the same command again")
    if found.result is None:
        return Answer(data, f"all {found.rounds} rounds are done\nrun: {found.run}\nnext: thorndike eval {found.run}")
    answer = trained(found.result)
    if found.status == "interrupted":
        text = f"interrupted in round {found.round} of {found.rounds}\nnext: the same command goes on"
        return Answer(data, text, exit_status=answer.exit_status)
    return Answer(data, answer.text, exit_status=answer.exit_status)
