"""``thorndike language demo``: RLHF from end to end on a small model, with a report."""

import sys
from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import (
    add_device_argument,
    add_settings_argument,
    configured,
    given_settings,
    prepare_device,
    settings_in_words,
)
from thorndike.cli.parser import Parser, seed_number
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

LEARNERS = ("ppo", "grpo", "rloo", "dpo", "ppo_without_kl", "ppo_max_kl")
EXAMPLES = """\
  thorndike language demo --out runs/demo
  thorndike language demo --out runs/demo --base runs/base/model --learners ppo,grpo,dpo --seed 1
Without --base a model of a million parameters is made first, from film reviews: that takes longer than all the rest, and is kept.
The same command again goes on where it stopped. Settings:
{settings}"""


def run(words: Sequence[str]) -> Answer:
    """All stages, and where the report is."""
    summary = "Labels, reward model, PPO and its rivals, and a report: film reviews that go on kindly, by real people's ratings."
    parser = Parser("language demo", summary, EXAMPLES.format(settings=settings_in_words("demo")))
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the run's folder")
    parser.add_argument("--base", type=Path, metavar="MODEL", help="a model of film reviews (default: made, and kept)")
    parser.add_argument("--learners", default="ppo", metavar="NAMES", help=f"of {', '.join(LEARNERS)} (default: ppo)")
    add_settings_argument(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    add_device_argument(parser)
    options = parser.parse(words)
    settings, learners = given_settings(options.settings, "demo"), options.learners.split(",")
    for name in learners:
        if name not in LEARNERS:
            raise UserError(f"--learners: there is no '{name}'{did_you_mean(name, LEARNERS)}")
    prepare_device(options.device, options.base)
    from thorndike.language.demo import Config, demo
    from thorndike.language.demo_report import write_report

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    found = demo(options.out, options.base, configured(Config, settings), learners, options.seed, tell)
    files = write_report(options.out, found)
    return Answer(
        {"run": options.out, "report": files.page, **found}, f"report: {files.page}\npicture: {files.picture}\nfigures: {files.figures}"
    )
