"""``thorndike studio``: the board in the browser, served to this machine until Ctrl-C."""

import sys
import webbrowser
from argparse import ArgumentTypeError
from collections.abc import Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.clips.arguments import STORE as CLIP_STORE
from thorndike.cli.find_run import add_output_argument
from thorndike.cli.language.preference_store import PROJECT, existing_project, media_folder, opened_store
from thorndike.cli.parser import Parser
from thorndike.errors import UserError

if TYPE_CHECKING:
    from thorndike.web.home import Door

PORT = 8420
_OPEN_TO_OTHERS = """\
Other machines reach it by this machine's address, with the same token. Nothing is encrypted: use it in networks that you trust."""
EXAMPLES = """\
  thorndike studio                   print an address to open in a browser; Ctrl-C ends the studio
  thorndike studio --open            open it, too
  thorndike studio --port 0          on any port that is free
  thorndike studio --game examples/own_game.py:NIM
  thorndike studio --label runs/swing       judge clips (or answers, --label prefs.db) in the same place"""


def run(words: Sequence[str]) -> Answer:
    """Serve the studio until the process is asked to stop."""
    parser = Parser("studio", "Play games in the browser, against what was trained, a search, or each other.", EXAMPLES)
    parser.add_argument("--port", metavar="N", type=port_number, default=PORT, help=f"where to listen; 0: any free one (default: {PORT})")
    parser.add_argument("--open", action="store_true", help="open the address in this machine's browser")
    host_help = "another address of this machine, to be reached from others (default: 127.0.0.1, this machine only)"
    parser.add_argument("--host", metavar="ADDRESS", default="127.0.0.1", help=host_help)
    game_help = "a game of your own, as module:NAME or path/to/file.py:NAME; may be given several times"
    parser.add_argument("--game", metavar="NAME", action="append", default=[], help=game_help)
    label_help = "a preference store, or a folder of clips, whose pairs are judged here, too"
    parser.add_argument("--label", metavar="STORE", help=label_help)
    parser.add_argument("--project", metavar="NAME", default=PROJECT, help=f"which of the store's projects (default: {PROJECT})")
    parser.add_argument("--media", type=Path, metavar="DIR", help="the folder of the store's clips (default: where the store is)")
    add_output_argument(parser)
    options = parser.parse(words)
    if options.label is None and (options.media is not None or options.project != PROJECT):
        raise UserError("--project and --media say what is judged: give --label STORE, or leave them out")
    for package in ("nicegui", "mctx"):
        if find_spec(package) is None:
            raise UserError(f"the studio needs {package}, which is not installed: pip install 'thorndike[web,games]'")

    from thorndike.games.registry import ADAPTED_GAMES, OWN_GAMES, game
    from thorndike.web.opponents import opponents_in
    from thorndike.web.server import serve

    store = None if options.label is None else _store(options.label)
    media = None if store is None else media_folder(store, options.media)

    def told(address: str) -> None:
        print(f"The studio is at {address}", flush=True)
        if options.host not in ("127.0.0.1", "::1", "localhost"):
            print(_OPEN_TO_OTHERS, file=sys.stderr)
        print("Ctrl-C ends it.", file=sys.stderr, flush=True)
        if options.open:
            webbrowser.open(address)

    for name in options.game:
        game(name)
    games = (*OWN_GAMES, *(ADAPTED_GAMES if find_spec("pgx") is not None else ()), *options.game)
    with ExitStack() as stack:
        doors: Sequence[Door] = ()
        if store is not None and media is not None:
            from thorndike.language.preferences.assignment import Plan
            from thorndike.web.label import Labelling
            from thorndike.web.label_server import doors_to

            opened = stack.enter_context(opened_store(store))
            number = existing_project(opened, options.project)
            doors = doors_to(Labelling(opened, number, options.project, Plan(), media))
        serve(games, opponents_in(options.output), options.host, options.port, told, doors=doors)
    return Answer({"status": "ended"}, "")


def _store(named: str) -> str:
    """The store that is named, or the one in a folder of clips. Raises ``UserError`` where there is none."""
    where = str(Path(named) / CLIP_STORE) if Path(named).is_dir() else named
    if "://" not in where and not Path(where).is_file():
        raise UserError(f"--label {named}: there is no preference store; make one: thorndike language import, or thorndike clips collect")
    return where


def port_number(text: str) -> int:
    """A port, or 0 for any that is free."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 5 and int(text) < 2**16):
        raise ArgumentTypeError(f"expected a port from 0 (any free one) to 65535; got '{text}'")
    return int(text)
