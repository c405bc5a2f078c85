"""``thorndike language import FILE``: preferences, or candidates to be compared, into a store."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.preference_store import add_store_arguments, opened_store, share
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError

EXAMPLES = """\
  thorndike language import candidates.jsonl --db prefs.db --guidelines guide.txt
  thorndike language import trl-preferences.jsonl --db prefs.db --rater published
  thorndike language import trl-preferences.jsonl --db prefs.db --ask
Rows: prompt and candidates (or completions); prompt, chosen and rejected; or prompt and completion, several of each prompt.
A candidate is a text, a list of messages, or {"media": "clip.mp4"}. The columns models (who made each) and best (of a gold
question: its place, from 0) are read, too."""


def run(words: Sequence[str]) -> Answer:
    """Read a file whole, and add what is new in it."""
    parser = Parser("language import", "Put preferences, or candidates to be compared, into a store.", EXAMPLES)
    parser.add_argument("file", metavar="FILE", type=Path, help="rows: .jsonl, .json or .csv")
    add_store_arguments(parser)
    parser.add_argument("--ask", action="store_true", help="take preferences for questions, not for judgements")
    parser.add_argument("--rater", metavar="NAME", default="imported", help="whose judgements preferences are (default: imported)")
    parser.add_argument("--raters", type=positive_whole, default=1, metavar="N", help="how many are asked of each item (default: 1)")
    parser.add_argument("--share-to-three", type=share, default=0.15, metavar="SHARE", help="of items that three are asked (default: 0.15)")
    parser.add_argument("--guidelines", type=Path, metavar="FILE", help="what raters are told, as plain text")
    parser.add_argument("--seed", type=seed_number, default=0, help="what the draw of those items follows from (default: 0)")
    options = parser.parse(words)
    guidelines = None if options.guidelines is None else _text(options.guidelines)
    with opened_store(options.db, new=True) as store:
        from thorndike.language.preferences.assignment import Plan
        from thorndike.language.preferences.formats import import_records
        from thorndike.language.preferences.records import read_records

        records = read_records(options.file)
        plan = Plan(options.raters, options.share_to_three, max(3, options.raters), seed=options.seed)
        project = store.project(options.project, guidelines)
        added = import_records(store, project, records, options.rater, plan, ask=options.ask)
    data = {"store": options.db, "project": options.project, "format": records.format, "rows": len(records.rows)}
    data |= {"items": added.items, "judgements": added.judgements, "left_out": added.left_out}
    known = f"; {added.left_out:,} left out, whose candidates are all the same" if added.left_out else ""
    known += "" if added.items or added.left_out else "; all of them were there already"
    rows = f"{len(records.rows):,} rows ({records.format.replace('_', ' ')})"
    text = f"{rows}: {added.items:,} new items, {added.judgements:,} judgements{known}"
    return Answer(data, f"{text}\nnext: thorndike language label --db {options.db}")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--guidelines {path} cannot be read as UTF-8 text: {error}") from error
