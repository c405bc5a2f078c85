"""``thorndike check-env ENVIRONMENT``: what is wrong with an environment, each finding with its fix. Exit status 1 if there are errors."""

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.environment_names import check_environment
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.cli.train import given_env_kwargs
from thorndike.environments.host.envpool_ids import pool_ids
from thorndike.environments.native import NATIVE
from thorndike.errors import UserError

if TYPE_CHECKING:
    from thorndike.environments.checker import Report

EXAMPLES = """\
  thorndike check-env CartPole-v1
  thorndike check-env my_file.py:MyEnv --env-set size=8
  thorndike check-env my_module:MyEnv-v0 --steps 5k --json"""


def run(words: Sequence[str]) -> Answer:
    """Play the environment with random actions, and list what was found."""
    parser = Parser("check-env", "Play an environment with random actions and list what is wrong with it, with fixes.", EXAMPLES)
    parser.add_argument("environment", nargs="?", metavar="ENVIRONMENT", help="an id, module:Id, module:Class or path/to/file.py:Class")
    parser.add_argument("--steps", type=positive_whole, default=1000, help="steps to record and repeat (default: 1000)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    parser.add_argument(
        "--env-set", action="append", default=[], metavar="NAME=VALUE", help="an argument of the environment; may be repeated"
    )
    parser.add_argument("--max-episode-steps", type=positive_whole, metavar="STEPS", help="a time limit instead of the environment's own")
    options = parser.parse(words)
    if options.environment is None:
        raise UserError("which environment? Name one, as in: thorndike check-env CartPole-v1")
    env_kwargs = given_env_kwargs(options.env_set)
    # Asked for Gymnasium's engine, a user's own environment is not made yet: whatever is wrong with it is for the check to say.
    engine = "auto" if options.environment in NATIVE or options.environment in pool_ids() else "gymnasium"
    check_environment(options.environment, engine=engine, env_kwargs=env_kwargs, max_episode_steps=options.max_episode_steps)
    from thorndike.api.checking import examine

    report = examine(
        options.environment,
        steps=options.steps,
        seed=options.seed,
        env_kwargs=env_kwargs,
        max_episode_steps=options.max_episode_steps,
    )
    counts = Counter(finding.severity for finding in report.findings)
    data = {
        "environment": options.environment,
        "seed": options.seed,
        "steps": report.steps,
        "episodes": report.episodes,
        "errors": counts["error"],
        "warnings": counts["warning"],
        "hints": counts["hint"],
        "findings": [finding._asdict() for finding in report.findings],
        "checked": report.checked,
        "not_checked": report.not_checked,
    }
    return Answer(data, _text(options.environment, options.seed, report, counts), exit_status=1 if counts["error"] else 0)


def _text(name: str, seed: int, report: "Report", counts: Counter[str]) -> str:
    lines = [f"{name}: {report.steps:,} steps with random actions from seed {seed}, {report.episodes:,} episodes ended"]
    for finding in report.findings:
        lines += [f"{finding.severity:<8} {finding.kind}: {finding.message}", f"{'':<8} fix: {finding.fix}"]
    lines.append(", ".join(_counted(counts[severity], severity) for severity in ("error", "warning", "hint")) if counts else "no findings")
    lines.append(f"checked: {', '.join(report.checked)}")
    if report.not_checked:
        lines.append(f"not checked, because of the errors: {', '.join(report.not_checked)}")
    return "\n".join(lines)


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
