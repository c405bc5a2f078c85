"""``thorndike language export``: a store's preferences as a file that TRL's trainers read."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.preference_store import add_store_arguments, existing_project, opened_store
from thorndike.cli.parser import Parser
from thorndike.errors import UserError

# As in language/preferences, which takes long to import.
_EXPORTS = ("preference", "implicit", "unpaired", "prompt_only", "prompt_completion", "judgements")
_METHODS = ("dawid_skene", "majority", "mean")
EXAMPLES = """\
  thorndike language export --db prefs.db --to prefs.jsonl
  thorndike language export --db prefs.db --to prefs.csv --aggregate majority --ties half
  thorndike language export --db prefs.db --to everything.jsonl --what judgements"""


def run(words: Sequence[str]) -> Answer:
    """Write a file that was not there before."""
    parser = Parser("language export", "Write a store's preferences as a file that TRL's trainers read.", EXAMPLES)
    add_store_arguments(parser)
    parser.add_argument("--to", type=Path, required=True, metavar="FILE", help="where to: .jsonl, .json or .csv")
    parser.add_argument("--what", choices=_EXPORTS, default="preference", help="what a row is (default: preference)")
    aggregate_help = "what is believed where raters disagree (default: dawid_skene)"
    parser.add_argument("--aggregate", choices=_METHODS, default="dawid_skene", help=aggregate_help)
    parser.add_argument("--ties", choices=("drop", "half"), default="drop", help="half: two rows of half the weight (default: drop)")
    options = parser.parse(words)
    if options.to.exists():
        raise UserError(f"--to {options.to} is there already: nothing is written over; choose another file")
    with opened_store(options.db) as store:
        from thorndike.language.preferences.formats import export_rows
        from thorndike.language.preferences.records import write_records

        rows = export_rows(store, existing_project(store, options.project), options.what, options.aggregate, options.ties)
    if not rows:
        raise UserError(f"the project '{options.project}' has nothing to export as {options.what} yet")
    written = write_records(options.to, rows)
    data = {"store": options.db, "project": options.project, "file": options.to, "what": options.what, "rows": written}
    return Answer(data, f"{written:,} rows: {options.to}")
