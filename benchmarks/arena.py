"""The matches of docs/arena.md: `thorndike arena` as anybody would run it, its answers in benchmarks/results/arena.json.

python benchmarks/arena.py               all of them; rows of others stay
python benchmarks/arena.py othello       those of a game
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path

from machine import commit, keep_row

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "arena.json"
COMMANDS = (
    "othello random rhino:level=1 rhino:level=3 --games 20",
    "othello mcts:simulations=400 rhino:level=1 --games 10",
    "connect_four random mcts:simulations=100 mcts:simulations=400 --games 40",
    "connect_four trained mcts:simulations=400 --games 40",
    "go_9x9 random gnugo:level=1 --games 10",
    "go_9x9 mcts:simulations=16 gnugo:level=1 --games 6",
    "chess random stockfish:elo=1350,movetime=20 fairy:skill=-20,movetime=20 --games 10",
)


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("game", nargs="?", help="the matches of this game only")
    chosen = parser.parse_args().game
    for words in COMMANDS:
        if chosen not in (None, words.split()[0]):
            continue
        began = cpu_seconds()
        command = [sys.executable, "-m", "thorndike", "arena", *words.split(), "--json"]
        answer = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        # With the engines' seconds, and compiling.
        row = {"commit": commit(ROOT), "seed": 0, "cpu_s": round(cpu_seconds() - began, 1), **answer}
        keep_row(RESULT, f"thorndike arena {words}", row)
        for each in answer["matches"]:
            print(words.split()[0], each["players"], each["wins"], each["draws"], each["losses"], flush=True)


if __name__ == "__main__":
    main()
