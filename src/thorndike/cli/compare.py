"""``thorndike compare RUN RUN...``: which learner is better, how sure that is, and how many more seeds would tell."""

import math
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, exists, find_run
from thorndike.cli.parser import Parser, positive_whole
from thorndike.cli.tables import table, text_of
from thorndike.plotting.style import check_plot_file
from thorndike.records import from_policy, read_policy_facts
from thorndike.statistics.comparison import FEWEST_SEEDS, MOST_SEEDS
from thorndike.training.run_groups import all_trained, group_runs, recorded_scores

if TYPE_CHECKING:
    from rich.console import RenderableType

    from thorndike.api import Comparison
    from thorndike.api.comparing import Compared
    from thorndike.statistics.comparison import Difference, Estimate

EXAMPLES = """\
  thorndike compare CartPole-v1/ppo CartPole-v1/dqn
  thorndike compare tuned,tuned-more-seeds default --plot comparison.svg
  thorndike compare Acrobot-v1/ppo CartPole-v1/ppo Acrobot-v1/dqn CartPole-v1/dqn --json"""


def run(words: Sequence[str]) -> Answer:
    """Compare, and say it in a table and a sentence."""
    parser = Parser("compare", "Say whether one learner is better than another, or that nobody can tell yet.", EXAMPLES)
    add_run_arguments(parser, several=True)
    parser.add_argument("--against", metavar="RUN", help="the baseline that the others are compared with (default: the last run)")
    parser.add_argument("--episodes", type=positive_whole, default=100, help="episodes of each seed, at least (default: 100)")
    parser.add_argument("--metric", choices=("iqm", "mean"), default="iqm", help="what the verdict is about (default: iqm)")
    parser.add_argument("--failed-below", metavar="RETURN", type=float, help="a seed with a mean return below it has failed")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="draw intervals, performance profiles and learning curves there")
    options = parser.parse(words)
    if options.plot is not None:
        check_plot_file(options.plot)
    runs = [_find_side(text, options.output) for text in options.runs]
    against = None if options.against is None else find_run(options.against, options.output)
    # JAX is not imported yet: what cannot be compared is told at once.
    for trained in all_trained(group_runs(runs, against)):
        if recorded_scores(trained, options.episodes) is None:
            from_policy(trained.run, read_policy_facts)
    from thorndike.api import compare

    found = compare(runs, metric=options.metric, episodes=options.episodes, against=against, failed_below=options.failed_below)
    if options.plot is not None:
        found.plot(options.plot)
    data = {
        "verdict": found.verdict,
        "difference": found.difference,
        "ci95": found.ci95,
        "p_improvement": found.p_improvement,
        "more_seeds": found.more_seeds,
        "runs": [_row(side) for side in found.runs],
    }
    return Answer(data, _draw(found, options.plot))


def _find_side(text: str, output: Path) -> list[Path]:
    """The runs of one learner: ``RUN`` or ``RUN,RUN``."""
    parts = [text] if exists(Path(text)) else text.split(",")
    return [find_run(part, output) for part in parts]


def _row(side: "Compared") -> dict[str, object]:
    """A side as JSON has it."""
    known, difference = side.standing, side.difference
    row: dict[str, object] = {
        "run": side.label,
        "directories": [run for together in side.runs.values() for run in together],
        "seeds": known.seeds,
    }
    row |= {"iqm": known.iqm.value, "iqm_ci95": known.iqm.ci95, "mean": known.mean.value, "mean_ci95": known.mean.ci95, "min": known.min}
    row |= {"failed": known.failed.value if known.failed else None, "failed_ci95": known.failed.ci95 if known.failed else None}
    return row | {"scores": side.scores, "against_baseline": None if difference is None else _difference_row(difference)}


def _difference_row(found: "Difference") -> dict[str, object]:
    return {
        "verdict": found.verdict,
        "difference": found.difference,
        "ci95": found.ci95,
        "iqm_difference": found.iqm.value,
        "iqm_ci95": found.iqm.ci95,
        "mean_difference": found.mean.value,
        "mean_ci95": found.mean.ci95,
        "p_improvement": found.p_improvement.value,
        "p_improvement_ci95": found.p_improvement.ci95,
        "p_value": found.p_value,
        "more_seeds": found.more_seeds,
    }


def _draw(found: "Comparison", plot: Path | None) -> "RenderableType":
    from rich.console import Group
    from rich.markup import escape

    rows = []
    for side in found.runs:
        known = side.standing
        row: dict[str, object] = {"run": side.label, "seeds": known.seeds, "IQM [95 %]": _estimate(known.iqm)}
        row |= {"mean [95 %]": _estimate(known.mean), "min": f"{known.min:.4g}"}
        rows.append(row | ({"failed": f"{known.failed.value:.0%}"} if known.failed else {}))
    sentences = [_sentence(side.label, side.difference, found) for side in found.runs if side.difference is not None]
    notes = [f"note: {note}" for note in found.notes]
    drawn = [] if plot is None else [f"plot: {shlex.quote(str(plot))}"]
    return Group(table(rows), *map(escape, ["", *sentences, *notes, *drawn]))


def _estimate(estimate: "Estimate") -> str:
    low, high = estimate.ci95
    return f"{estimate.value:.4g}" + ("" if math.isnan(low) else f" [{low:.4g}, {high:.4g}]")


def _sentence(label: str, told: "Difference", found: "Comparison") -> str:
    name = {"iqm": "interquartile mean", "mean": "mean"}[found.metric]
    low, high = told.ci95
    interval = "" if math.isnan(low) else f" (95 % interval {low:+.4g} to {high:+.4g})"
    evidence = f"{name} {told.difference:+.4g}{interval}"
    if told.verdict == "cannot tell":
        return f"Cannot tell {label} from {found.baseline} yet: {evidence}; {_what_would(told, found)}."
    chance = f"a seed of {label} beats one of {found.baseline} with probability {told.p_improvement.value:.2f}"
    return f"{label} is {told.verdict} than {found.baseline}: {evidence}; {chance}."


def _what_would(told: "Difference", found: "Comparison") -> str:
    """Why nobody can tell, and how many more seeds would."""
    seeds = min(side.standing.seeds for side in found.runs)
    low, high = told.ci95
    why = ""
    if seeds < FEWEST_SEEDS:
        why = f"a verdict needs {FEWEST_SEEDS} seeds of each; "
    elif not low <= 0 <= high:
        why = f"the interval leaves 0 out, but of so few seeds it is too narrow (permutation test: p = {told.p_value:.2g}); "
    if told.more_seeds is None:
        return why + ("no difference was seen" if told.difference == 0 else f"so small a one would take over {MOST_SEEDS:,} seeds of each")
    # It rests on an estimated spread and difference: two digits are more than enough.
    about = text_of(int(float(f"{told.more_seeds:.2g}")))
    return f"{why}about {about} more seeds of each would, if the difference is what it seems"
