"""``thorndike eval RUN``: the trained policy on fresh environments of the reference engine."""

from argparse import SUPPRESS
from collections.abc import Sequence
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.records import from_policy, read_policy_facts

if TYPE_CHECKING:
    from thorndike.training.evaluation import Bias

EXAMPLES = """\
  thorndike eval latest
  thorndike eval CartPole-v1/ppo --episodes 1000 --json"""


def run(words: Sequence[str]) -> Answer:
    """Evaluate every seed of a run, and say how well it does."""
    parser = Parser("eval", "Score every seed of a trained run on fresh Gymnasium environments.", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("--eval-episodes", dest="episodes", type=positive_whole, default=SUPPRESS, help=SUPPRESS)
    parser.add_argument("--episodes", type=positive_whole, default=100, help="episodes of each seed (default: 100)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number the episodes follow from (default: 0)")
    parser.add_argument("--num-envs", type=positive_whole, default=20, help="environments of each seed, stepped together")
    parser.add_argument("--stochastic", action="store_true", help="draw actions from the policy instead of taking the best one")
    options = parser.parse(words)
    directory = find_run(options.run, options.output)
    # JAX is not imported yet: a policy that is damaged, or not there, is told of at once.
    from_policy(directory, read_policy_facts)
    from thorndike.api import load

    policy = load(directory)
    found = policy.evaluate(episodes=options.episodes, seed=options.seed, num_envs=options.num_envs, deterministic=not options.stochastic)
    data = {
        "run": found.run,
        "environment": found.environment,
        "protocol": policy.protocol,
        "episodes": found.episodes,
        "mean": found.mean,
        "iqm": found.iqm,
        "min": found.min,
        "ci95": found.ci95,
        "per_seed": found.per_seed,
        "value_bias": None if found.value_bias is None else found.value_bias._asdict(),
    }
    low, high = found.ci95
    whose = "the only seed" if len(found.per_seed) == 1 else f"each of {len(found.per_seed)} seeds"
    protocol = "" if policy.protocol is None else f" ({policy.protocol})"
    text = (
        f"{found.environment}{protocol}, {found.episodes:,} episodes of {whose}\n"
        f"mean {found.mean:.4g} (95 % interval {low:.4g} to {high:.4g}), interquartile mean {found.iqm:.4g}, worst seed {found.min:.4g}\n"
        f"per seed: {', '.join(f'{value:.4g}' for value in found.per_seed)}\n" + _on_values(found.value_bias, policy.incomparable_values)
    )
    return Answer(data, text)


def _on_values(bias: "Bias | None", why_not: str | None) -> str:
    if bias is None:
        return f"values against returns: left out, {why_not}"
    low, high = bias.ci95
    return f"values against returns: {bias.mean:+.4g} (95 % interval {low:+.4g} to {high:+.4g}); above 0, the learner expects too much"
