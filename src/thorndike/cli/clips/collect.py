"""``thorndike clips collect ENVIRONMENT``: record pairs of clips."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.clips.arguments import add_clip_arguments, to_label
from thorndike.cli.environment_names import check_environment
from thorndike.cli.find_run import add_output_argument, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.cli.train import check_output, given_env_kwargs

PAIRS = 50
EXAMPLES = """\
  thorndike clips collect Pendulum-v1 --to runs/swing                    actions at random
  thorndike clips collect Pendulum-v1 --to runs/swing --run latest       the newest run's policy
  thorndike clips collect my_module:MyEnv-v0 --to runs/mine --length 40 --question "Which walks more calmly?"
  thorndike clips collect Pendulum-v1 --to runs/try --no-films           for `thorndike clips judge` only"""


def run(words: Sequence[str]) -> Answer:
    """Record, and say where they are judged."""
    parser = Parser("clips collect", "Record pairs of clips of an agent, or of random actions, as films and as arrays.", EXAMPLES)
    parser.add_argument("environment", metavar="ENVIRONMENT", help="a Gymnasium id, module:Id, or path/to/file.py:ClassName")
    parser.add_argument("--to", type=Path, required=True, metavar="DIR", help="the folder of clips; it is made, or added to")
    parser.add_argument("--pairs", type=positive_whole, default=PAIRS, metavar="N", help=f"that are asked (default: {PAIRS})")
    parser.add_argument("--run", metavar="RUN", help="whose policy acts (default: actions at random)")
    add_clip_arguments(parser)
    parser.add_argument("--no-films", action="store_true", help="arrays alone: nobody can look at them")
    parser.add_argument(
        "--env-set", action="append", default=[], metavar="NAME=VALUE", help="an argument of the environment; may be repeated"
    )
    parser.add_argument("--max-episode-steps", type=positive_whole, metavar="STEPS", help="a time limit instead of the environment's own")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    add_output_argument(parser)
    options = parser.parse(words)
    env_kwargs = given_env_kwargs(options.env_set)
    check_output(options.to)
    check_environment(options.environment, engine="auto", env_kwargs=env_kwargs, max_episode_steps=options.max_episode_steps)
    acting = None if options.run is None else find_run(options.run, options.output)
    from thorndike.api.clips import QUESTION, collect_clips

    found = collect_clips(
        options.environment,
        options.to,
        pairs=options.pairs,
        run=acting,
        length=options.length,
        question=options.question or QUESTION,
        films=not options.no_films,
        env_kwargs=env_kwargs,
        max_episode_steps=options.max_episode_steps,
        seed=options.seed,
    )
    following = f"thorndike clips judge {found.folder}" if options.no_films else to_label(found.folder)
    text = f"{found.pairs} pairs of clips of {found.made_by}, chosen by {found.chosen_by}, in {found.folder}\nnext: {following}"
    return Answer(found._asdict(), text)
