"""``thorndike record RUN``: what a trained policy does, as a dataset that Minari reads too."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, exists, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError
from thorndike.records import from_policy, read_policy_facts

EXAMPLES = """\
  thorndike record latest --episodes 200
  thorndike record CartPole-v1/ppo --deterministic --random-share 0.2 --to datasets/CartPole-v1/noisy-v0
  thorndike train iql datasets/CartPole-v1/noisy-v0 --steps 20k"""


def run(words: Sequence[str]) -> Answer:
    """Record episodes of a run's policy, and say where the dataset is and how good it was."""
    parser = Parser("record", "Record a trained policy on fresh Gymnasium environments, in Minari's format.", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("--episodes", type=positive_whole, help="whole episodes (default: 100)")
    parser.add_argument("--steps", type=positive_whole, help="whole episodes until there are so many steps, instead")
    parser.add_argument("--deterministic", action="store_true", help="the policy's best actions, instead of those it learnt with")
    parser.add_argument("--random-share", type=probability, default=0.0, metavar="X", help="this share of actions is uniform instead")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number the episodes follow from (default: 0)")
    parser.add_argument("--to", type=Path, metavar="DIR", help="the new folder (default: datasets/ENVIRONMENT/ALGORITHM-v0)")
    options = parser.parse(words)
    if options.episodes is not None and options.steps is not None:
        raise UserError("record so many episodes or so many steps: give --episodes or --steps, not both")
    if options.to is not None and exists(options.to):
        raise UserError(f"--to {options.to} is there already: a dataset is never written over; choose another folder")
    directory = find_run(options.run, options.output)
    # JAX is not imported yet: a policy that is damaged, or not there, is told of at once.
    from_policy(directory, read_policy_facts)
    from thorndike.api import record

    found = record(
        directory,
        episodes=options.episodes,
        steps=options.steps,
        deterministic=options.deterministic,
        random_share=options.random_share,
        seed=options.seed,
        to=options.to,
    )
    returns = found.returns
    data = {
        "dataset": found.path,
        "environment": found.origin.environment,
        "episodes": len(found.lengths),
        "steps": len(found.reward),
        "mean": returns.mean(),
        "min": returns.min(),
        "max": returns.max(),
        "probabilities": found.probability is not None,
    }
    text = (
        f"{len(found.lengths):,} episodes of {found.origin.environment}, {len(found.reward):,} steps, mean return {returns.mean():.4g} "
        f"({returns.min():.4g} to {returns.max():.4g})\ndataset: {found.path}\nnext: thorndike train bc {found.path}"
    )
    return Answer(data, text)


def probability(text: str) -> float:
    """A number from 0 to 1."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 <= number <= 1.0:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to 1; got '{text}'")
    return number
