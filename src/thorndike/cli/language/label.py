"""``thorndike language label``: the page on which people say which answer, or which clip, is better."""

import math
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from thorndike.cli.answer import Answer
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.preference_store import add_store_arguments, existing_project, media_folder, opened_store, share
from thorndike.cli.parser import Parser, seed_number
from thorndike.cli.studio import port_number
from thorndike.errors import UserError
from thorndike.user_code import attribute_in_file, load_file, one_line

PORT = 8430
EXAMPLES = """\
  thorndike language label --db prefs.db
  thorndike language label --db prefs.db --host 192.168.1.20      raters on other machines of your network
  thorndike language label --db clips.db --media runs/clips       two films side by side
  thorndike language label --db prefs.db --simulate taste.py:worth     worth(prompt, candidate) -> how good it is"""


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
    simulate_help = "no page: a simulated crowd (8 fair, 3 who guess, 1 the wrong way round) judges by a function of prompt and candidate"
    parser.add_argument("--simulate", metavar="FILE.py:FUNCTION", help=simulate_help)
    options = parse_with_config(parser, words, "label", None)
    if options.simulate is not None:
        return _simulate(options.db, options.project, options.simulate, (options.gold, options.repeats, options.seed))
    if find_spec("nicegui") is None:
        raise UserError("the page needs what the studio needs, which is not installed: pip install 'thorndike[web]'")
    media = media_folder(options.db, options.media)
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


def _simulate(where: str, project: str, name: str, shares: tuple[float, float, int]) -> Answer:
    """Let the crowd judge all that is left."""
    found = attribute_in_file(name)
    if found is None:
        raise UserError(f"--simulate is '{name}', but it must be path/to/file.py:function")
    utility = getattr(load_file(found[0], found[1]), found[1], None)
    if not callable(utility):
        raise UserError(f"{found[0]} defines no function {found[1]}")

    def checked(prompt: Mapping[str, object], candidate: Mapping[str, object]) -> float:
        try:
            worth = float(utility(prompt, candidate))
        except Exception as error:
            raise UserError(f"{name} failed: {type(error).__name__}: {one_line(error)}") from error
        if not math.isfinite(worth):
            raise UserError(f"{name} returned {worth}, but what a candidate is worth must be a finite number")
        return worth

    with opened_store(where) as store:
        from thorndike.language.preferences.assignment import Plan
        from thorndike.language.preferences.raters import crowd, let_them_judge

        number = existing_project(store, project)
        gold, repeats, seed = shares
        made = let_them_judge(store, number, crowd(), checked, plan=Plan(gold=gold, repeats=repeats, seed=seed), seed=seed)
        progress = store.progress(number)
    data = {"status": "simulated", "made": made, "judgements": progress.judgements, "done": progress.done, "items": progress.items}
    text = f"{made:,} judgements made, {progress.done:,} of {progress.items:,} items done"
    return Answer(data, f"{text}\nnext: thorndike language agree --db {where}")
