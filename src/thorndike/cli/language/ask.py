"""``thorndike language ask``: the order in which people are asked, by where an ensemble of reward models disagrees."""

from collections.abc import Sequence
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import add_device_argument, prepare_device
from thorndike.cli.language.preference_store import add_store_arguments, existing_project, opened_store
from thorndike.cli.parser import Parser

EXAMPLES = """\
  thorndike language ask --db prefs.db --reward runs/reward/model
While raters are at work, too: the labelling page takes the next question by the new order."""


def run(words: Sequence[str]) -> Answer:
    """Put a project's questions in order."""
    summary = "Ask first what the members of a reward model (--members 3) disagree about most; the labelling page goes by it."
    parser = Parser("language ask", summary, EXAMPLES)
    add_store_arguments(parser)
    parser.add_argument("--reward", type=Path, required=True, metavar="MODEL", help="a reward model of several members")
    add_device_argument(parser)
    options = parser.parse(words)
    prepare_device(options.device, options.reward)
    with opened_store(options.db) as store:
        from thorndike.language.asking import ask_where_members_disagree
        from thorndike.language.reward_files import load_reward_model

        found = ask_where_members_disagree(store, existing_project(store, options.project), load_reward_model(options.reward))
    data = {"store": options.db, "project": options.project, "reward": options.reward, **found._asdict()}
    text = f"{found.items:,} questions in order: the members' chances differ by {found.mean:.3f} on average, {found.highest:.3f} at most"
    return Answer(data, f"{text}\nnext: thorndike language label --db {options.db}")
