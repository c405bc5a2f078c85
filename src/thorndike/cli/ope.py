"""``thorndike ope RUN --data DATASET``: off-policy evaluation, or a line that says why these data cannot tell."""

from argparse import ArgumentTypeError
from collections.abc import Sequence
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.cli.record import probability
from thorndike.errors import UserError
from thorndike.learning_sources import METADATA, is_dataset
from thorndike.records import from_policy, read_policy_facts

if TYPE_CHECKING:
    from thorndike.statistics.off_policy import Estimate

EXAMPLES = """\
  thorndike ope latest --data datasets/CartPole-v1/noisy-v0
  thorndike ope CartPole-v1/iql --data datasets/CartPole-v1/noisy-v0 --methods fqe --gamma 0.95 --json"""


def run(words: Sequence[str]) -> Answer:
    """Estimate the discounted return of a run's policy from a dataset."""
    parser = Parser("ope", "Say what a trained policy is worth from recorded episodes alone (discounted return).", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("--data", metavar="DATASET", required=True, help="the dataset's folder")
    parser.add_argument("--methods", metavar="M,M", type=method_names, help="pdis, wis, dr, fqe (default: all that the data support)")
    parser.add_argument("--gamma", type=discount, default=0.99, help="discount (default: 0.99)")
    parser.add_argument("--stochastic", action="store_true", help="judge the policy as it acts while it learns, not its best actions")
    parser.add_argument("--fqe-steps", type=positive_whole, default=10_000, help="minibatches of the fitted values (default: 10,000)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    options = parser.parse(words)
    if not is_dataset(options.data):
        raise UserError(f"{options.data} is no dataset: it has no {METADATA}; make one: thorndike record RUN")
    directory = find_run(options.run, options.output)
    # JAX is not imported yet: a policy that is damaged, or not there, is told of at once.
    from_policy(directory, read_policy_facts)
    from thorndike.api import evaluate_offline

    found = evaluate_offline(
        directory,
        options.data,
        methods=options.methods,
        gamma=options.gamma,
        deterministic=not options.stochastic,
        steps=options.fqe_steps,
        seed=options.seed,
    )
    shown = ("run", "dataset", "environment", "episodes", "gamma", "effective_episodes", "agreement")
    data = {
        **{name: getattr(found, name) for name in shown},
        "behavior": found.behavior._asdict(),
        "estimates": {name: estimate._asdict() for name, estimate in found.estimates.items()},
        "refused": found.refused,
    }
    lines = [f"{found.environment}, discounted return (gamma {found.gamma:g}) from {found.episodes:,} episodes of {found.dataset}"]
    lines += [_line(name, each) for name, each in {"the data's own policy": found.behavior, **found.estimates}.items()]
    lines += [f"{name}: refused: {why}" for name, why in found.refused.items()]
    return Answer(data, "\n".join(lines))


def _line(name: str, estimate: "Estimate") -> str:
    low, high = estimate.ci95
    return f"{name}: {estimate.value:.4g} (95 % interval {low:.4g} to {high:.4g})"


def method_names(text: str) -> list[str]:
    """Names between commas."""
    names = [name.strip() for name in text.split(",")]
    known = ("pdis", "wis", "dr", "fqe")
    for name in names:
        if name not in known:
            raise ArgumentTypeError(f"expected some of {', '.join(known)}, with commas between; got '{text}'")
    return names


def discount(text: str) -> float:
    """A number from 0 to below 1."""
    number = probability(text)
    if number == 1.0:
        raise ArgumentTypeError("expected a number below 1: what lies behind a time limit counts too")
    return number
