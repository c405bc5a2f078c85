"""``thorndike language label``: the page on which people say which answer, or which clip, is better."""

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.preference_store import add_store_arguments, existing_project, opened_store, share
from thorndike.cli.parser import Parser, seed_number
from thorndike.cli.studio import port_number
from thorndike.errors import UserError

PORT = 8430
EXAMPLES = """\
  thorndike language label --db prefs.db
  thorndike language label --db prefs.db --host 192.168.1.20      raters on other machines of your network
  thorndike language label --db clips.db --media runs/clips       two films side by side"""


def run(words: Sequence[str]) -> Answer:
    """Serve the page until the process is asked to stop."""
    parser = Parser("language label", "Serve a page on which people say which answer, or which clip, is better.", EXAMPLES)
    add_store_arguments(parser)
    parser.add_argument("--port", metavar="N", type=port_number, default=PORT, help=f"where to listen; 0: any free one (default: {PORT})")
    host_help = "another address of this machine, to be reached from others (default: 127.0.0.1, this machine only)"
    parser.add_argument("--host", metavar="ADDRESS", default="127.0.0.1", help=host_help)
    parser.add_argument("--media", type=Path, metavar="DIR", help="the folder of the clips (default: where the store is)")
    parser.add_argument("--gold", type=share, default=0.05, metavar="SHARE", help="of gold questions, if there are any (default: 0.05)")
    parser.add_argument("--repeats", type=share, default=0.03, metavar="SHARE", help="of items that are asked again (default: 0.03)")
    parser.add_argument("--seed", type=seed_number, default=0, help="what sides and draws follow from (default: 0)")
    options = parser.parse(words)
    if find_spec("nicegui") is None:
        raise UserError("the page needs what the studio needs, which is not installed: pip install 'thorndike[web]'")
    media = options.media if options.media is not None else Path("." if "://" in options.db else Path(options.db).parent)
    if not media.is_dir():
        raise UserError(f"--media {media} is not a folder")
    with opened_store(options.db) as store:
        from thorndike.language.preferences.assignment import Plan
        from thorndike.web.label import Labelling
        from thorndike.web.label_server import serve_labelling

        plan = Plan(gold=options.gold, repeats=options.repeats, seed=options.seed)
        labelling = Labelling(store, existing_project(store, options.project), options.project, plan, media)

        def told(raters: str, owner: str) -> None:
            print(f"Raters: {raters}", flush=True)
            print(f"Only you: {owner}", flush=True)
            if options.host != "127.0.0.1":
                print("Whoever has an address can use it: it is not encrypted, so use it in networks that you trust.", file=sys.stderr)
            print("Ctrl-C ends it; what was judged is in the store.", file=sys.stderr, flush=True)

        serve_labelling(labelling, options.host, options.port, told)
        progress = store.progress(labelling.project)
    return Answer({"status": "ended", "judgements": progress.judgements, "done": progress.done, "items": progress.items}, "")
