"""``thorndike language agree``: how far raters agree, and how far each can be trusted."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.language.preference_store import add_store_arguments, existing_project, opened_store
from thorndike.cli.parser import Parser
from thorndike.cli.tables import facts_table, table

EXAMPLES = """\
  thorndike language agree --db prefs.db
  thorndike language agree --db postgresql://me@localhost/prefs --json"""


def run(words: Sequence[str]) -> Answer:
    """Agreement of all, and a row a rater."""
    parser = Parser("language agree", "Say how far raters agree, and how far each can be trusted.", EXAMPLES)
    add_store_arguments(parser)
    options = parser.parse(words)
    with opened_store(options.db) as store:
        from thorndike.language.preferences.agreement import agreement
        from thorndike.language.preferences.comparisons import compared
        from thorndike.language.preferences.noise import dawid_skene

        project = existing_project(store, options.project)
        judged, progress = store.judged(project), store.progress(project)
    comparisons, found = compared(judged), agreement(judged)
    trusted = dict(zip(comparisons.raters, dawid_skene(comparisons).belief.reliability.tolist(), strict=True))
    facts: dict[str, object] = {"items": progress.items, "done": progress.done, "judgements": progress.judgements}
    facts |= {"pairs": found.pairs, "shared_pairs": found.shared_pairs, "raw": found.raw, "raw_ci95": found.raw_ci95}
    facts |= {"cohen_kappa": found.cohen_kappa, "fleiss_kappa": found.fleiss_kappa}
    facts |= {"alpha_nominal": found.alpha_nominal, "alpha_ordinal": found.alpha_ordinal}
    rows = []
    for each in found.raters:
        row: dict[str, object] = {"rater": each.rater, "judged": each.judgements, "skipped": each.skipped}
        row |= {"agrees": each.with_others.value, "gold": each.gold.value, "consistency": each.consistency.value}
        row |= {"first_side": each.left.value, "cycles": each.cycles.value, "seconds": each.median_seconds}
        rows.append(row | {"reliability": trusted.get(each.rater)})
    data = {"store": options.db, "project": options.project, **facts, "raters": rows}
    if not rows:
        return Answer(data, "nobody has judged anything yet")
    from rich.console import Group

    shown = [{name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()} for row in rows]
    return Answer(
        data, Group(facts_table(options.project, {name.replace("_", " "): value for name, value in facts.items()}), "", table(shown))
    )
