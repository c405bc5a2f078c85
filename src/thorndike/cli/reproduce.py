"""``thorndike reproduce RUN``: make a run again, and say whether it is the same, bit for bit."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_run_arguments, find_run
from thorndike.cli.parser import Parser, positive_whole
from thorndike.records import read_record

EXAMPLES = """\
  thorndike reproduce latest
  thorndike reproduce CartPole-v1/ppo --steps 20k --json"""


def run(words: Sequence[str]) -> Answer:
    """Make the run again and compare; exit status 0 if it is identical, 1 if not."""
    parser = Parser("reproduce", "Make a run again from its first step, and compare metrics and checkpoints bit for bit.", EXAMPLES)
    add_run_arguments(parser)
    parser.add_argument("--steps", type=positive_whole, help="how far, in steps of each seed (default: as far as the run came)")
    options = parser.parse(words)
    directory = find_run(options.run, options.output)
    # JAX is not imported yet: what cannot be made again is told at once.
    read_record(directory)
    from thorndike.api import reproduce

    found = reproduce(directory, steps=options.steps, progress=not options.json)
    data = {
        "run": found.run,
        "identical": found.identical,
        "steps": found.steps,
        "lines": found.lines,
        "checkpoints": found.checkpoints,
        "difference": found.difference,
    }
    compared = f"{found.lines} lines of metrics.jsonl, " + (
        f"checkpoints of step {', '.join(map(str, found.checkpoints))}" if found.checkpoints else "no checkpoint"
    )
    if found.identical:
        return Answer(data, f"identical: {found.run}, {found.steps:,} steps made again; compared: {compared}")
    return Answer(data, f"different: {found.run}, by step {found.steps:,}: {found.difference}\nequal until then: {compared}", exit_status=1)
