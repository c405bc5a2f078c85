"""``thorndike clips judge DIR``: a program chooses, by the environment's own reward."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.clips.arguments import add_rater_arguments, clips_folder
from thorndike.cli.parser import Parser, seed_number

EXAMPLES = """\
  thorndike clips judge runs/try
  thorndike clips judge runs/try --temperature 0 --error-rate 0.1"""


def run(words: Sequence[str]) -> Answer:
    """Judge what is left, and say how much that was."""
    parser = Parser("clips judge", "Let a program choose between all pairs that wait, by the environment's own reward.", EXAMPLES)
    parser.add_argument("folder", metavar="DIR", type=Path, help="a folder of clips")
    add_rater_arguments(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="what its errors follow from (default: 0)")
    options = parser.parse(words)
    folder = clips_folder(options.folder)
    from thorndike.api.clips import judge_clips

    made = judge_clips(folder, temperature=options.temperature, error_rate=options.error_rate, seed=options.seed)
    return Answer(
        {"folder": folder, "judgements": made},
        f"{made:,} choices made\nnext: thorndike clips fit {folder}, or thorndike clips train as before",
    )
