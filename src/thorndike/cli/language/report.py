"""What a verb that trains a language model answers."""

from typing import TYPE_CHECKING, cast

from thorndike.cli.answer import Answer
from thorndike.training.run_directory import read_lines

if TYPE_CHECKING:
    from thorndike.language.text_run import TextOutcome

_SHOWN = ("train/loss", "eval/loss", "eval/perplexity")


def report(outcome: "TextOutcome") -> Answer:
    """Where the run is, how it ended, and the last figures of its log."""
    rows = read_lines(outcome.run / "metrics.jsonl")
    last = {name: value for row in rows for name, value in row.items() if name.startswith(("train/", "eval/"))}
    model = outcome.run / "model"
    data = {"run": outcome.run, "status": outcome.status, "steps": outcome.steps, "wall_s": outcome.wall_s, "cpu_s": outcome.cpu_s, **last}
    shown = ", ".join(f"{name} {cast(float, last[name]):.4g}" for name in _SHOWN if name in last)
    text = f"{outcome.status} after {outcome.steps:,} steps, {outcome.cpu_s:,.0f} CPU-seconds: {shown}\nrun: {outcome.run}"
    if outcome.status == "finished":
        return Answer(data | {"model": model}, f'{text}\nmodel: {model}\nnext: thorndike language generate {model} --prompt "The"')
    return Answer(data, f"{text}\nthe same command again goes on from here", 130)
