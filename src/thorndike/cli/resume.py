"""``thorndike resume RUN``: go on where a run stopped."""

from argparse import SUPPRESS
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser, positive_whole
from thorndike.cli.train import check_reward, trained
from thorndike.records import read_record
from thorndike.training.run_lock import refuse_if_locked

EXAMPLES = """\
  thorndike resume latest
  thorndike resume runs/CartPole-v1/ppo/20260101-120000-first --steps 1M
  thorndike resume latest --steps 200k --reward runs/swing"""


def run(words: Sequence[str]) -> Answer:
    """Train on, and say how it went."""
    parser = Parser("resume", "Go on with an interrupted run to its end, or with a finished one up to more steps.", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("-n", "--total-timesteps", "--n-timesteps", dest="steps", type=positive_whole, help=SUPPRESS)
    parser.add_argument("--steps", type=positive_whole, help="steps of each seed in all (default: as planned)")
    parser.add_argument("--reward", type=Path, metavar="DIR", help="a folder of clips, whose newest reward is trained on from here on")
    options = parser.parse(words)
    check_reward(options.reward)
    directory = find_run(options.run, options.output)
    refuse_if_locked(directory)
    # JAX is not imported yet: what cannot be gone on with is told at once.
    read_record(directory)
    from thorndike.api import resume

    return trained(resume(directory, steps=options.steps, reward=options.reward, progress=not options.json))
