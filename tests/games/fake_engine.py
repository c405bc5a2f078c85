"""An engine that misbehaves on request: `fake_engine.py PROTOCOL FAULT [FOLDER]`. It plays the moves it is given in FOLDER/moves, in turn.

Faults: none, dies (at its second move), dies-once, hangs, illegal, resigns, babbles, refuses, silent, stays (ignores quit), endless-line.
"""

import os
import signal
import sys
import time
from pathlib import Path


def main(protocol, fault, folder):
    folder = Path(folder)
    moves, asked = (folder / "moves").read_text().split(), 0
    with (folder / "started").open("a") as file:
        file.write(f"{os.getpid()}\n")
    log = (folder / "heard").open("a")
    if fault == "stays":
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    known = 0
    for line in sys.stdin:
        words = line.split()
        log.write(line)
        log.flush()
        if fault == "silent":
            continue
        if words[:1] == ["quit"]:
            if fault == "stays":
                time.sleep(600)
            return
        if protocol == "gtp" and words[0] not in ("genmove", "kgs-genmove_cleanup"):
            if fault == "refuses":
                say("? unknown command\n")
            elif fault == "babbles":
                say("thinking...\n\n= \nmore\n")
            else:
                say("= \n")
            known = 0 if words[0] == "clear_board" else known + (words[0] == "play") - (words[0] == "undo")
            continue
        if protocol != "gtp" and words[0] != "go":
            if words[0] in ("uci", "usi"):
                say("id name Fake\noption name Level type spin\n" + words[0] + "ok")
            elif words[0] == "isready":
                say("readyok")
            elif words[0] == "position":
                known = len(words) - 3 if "moves" in words else 0
            continue
        asked += 1
        restarted = len((folder / "started").read_text().split()) > 1
        if (fault == "dies" and known > 1) or (fault == "dies-once" and known > 1 and not restarted):
            os._exit(3)
        if fault == "hangs" and known > 1:
            time.sleep(600)
        if fault == "endless-line":
            while True:
                sys.stdout.write("x" * 10_000)
        move = "z99" if fault == "illegal" else "resign" if fault == "resigns" and protocol == "gtp" else moves[known % len(moves)]
        known += 1
        say(f"= {move}\n" if protocol == "gtp" else f"info depth 1 score cp 100 pv {move}\nbestmove {move} ponder a1")


def say(text):
    print(text, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:4])
