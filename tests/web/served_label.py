"""A labelling page in a process of its own: served_label.py STORE PORT TOKEN KEY. Prints the raters' address, then the owner's."""

import sys
from pathlib import Path

from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.store import Store
from thorndike.web.label import Labelling
from thorndike.web.label_server import serve_labelling


def told(raters: str, owner: str) -> None:
    print(raters, flush=True)
    print(owner, flush=True)


if __name__ == "__main__":
    where, port, token, key = sys.argv[1:]
    with Store(where) as store:
        labelling = Labelling(store, store.project("answers"), "answers", Plan(repeats=0.03), Path(where).parent)
        serve_labelling(labelling, "127.0.0.1", int(port), told, token, key)
