"""``thorndike show RUN``: what a run is, how far it came, what it logged last."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser
from thorndike.cli.tables import facts_table, mean
from thorndike.statistics.estimates import summary
from thorndike.training.json_files import NUMBER, check_fields, parse_object, whole
from thorndike.training.run_listing import last_row, read_facts

if TYPE_CHECKING:
    from rich.console import RenderableType


def run(words: Sequence[str]) -> Answer:
    """All that is known of a run, from its files."""
    parser = Parser("show", "Show a run's settings, its state, its last metrics and its last evaluation.", "  thorndike show latest")
    add_run_arguments(parser)
    options = parser.parse(words)
    directory = find_run(options.run, options.output)
    facts = read_facts(directory)
    metrics = last_row(directory / "metrics.jsonl")
    evaluation = last_evaluation(directory / "evaluations.jsonl")
    data = {"run": directory, **facts, "metrics": metrics, "evaluation": evaluation}
    return Answer(data, _draw(directory, facts, metrics, evaluation))


def last_evaluation(path: Path) -> dict[str, object] | None:
    """Episodes of each seed, mean, interquartile mean, worst seed and interval of what was evaluated last; None if nothing was.

    A file holds one evaluation after another; a new one starts where a seed's episodes count from 0 again.
    """
    lines = path.read_bytes().split(b"\n")[:-1] if path.is_file() else []
    returns: dict[int, list[float]] = {}
    for line in lines:
        row = parse_object(line, path)
        check_fields(row, {"seed": whole(0), "episode": whole(0), "return": NUMBER}, path)
        seed = cast(int, row["seed"])
        if row["episode"] == 0:
            returns[seed] = []
        returns.setdefault(seed, []).append(cast(float, row["return"]))
    if not returns:
        return None
    found = summary([sum(values) / len(values) for values in returns.values()])
    return {"episodes": min(map(len, returns.values())), "mean": found.mean, "iqm": found.iqm, "min": found.min, "ci95": found.ci95}


def _draw(
    directory: Path, facts: Mapping[str, object], metrics: Mapping[str, object], evaluation: Mapping[str, object] | None
) -> "RenderableType":
    from rich.console import Group

    config = facts.get("config")
    plain = {name: value for name, value in facts.items() if name != "config"}
    parts = [facts_table(str(directory), plain), facts_table("settings", config if isinstance(config, Mapping) else {})]
    if metrics:
        parts.append(facts_table("last metrics", {name: mean(value) for name, value in metrics.items()}))
    if evaluation is not None:
        parts.append(facts_table("last evaluation", evaluation))
    return Group(*parts)
