"""How long the trained policy of Connect Four takes for a move with 64 simulations, at the terminal and by itself.

python benchmarks/answer_time.py         into benchmarks/results/answer_time.json

At the terminal: the slowest answer of each game of `thorndike play connect_four --json`, by the clock. By itself: CPU-seconds of each move
of one game against random moves, the first, which compiles, left out.
"""

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np

import thorndike as td
from machine import origin, processor
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.game import Turn
from thorndike.games.match import compiled

RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "answer_time.json"
GAMES, SIMULATIONS = 2, 64


def at_the_terminal(seed: int) -> float:
    """The slowest answer of a game in which somebody types columns at random, by the clock."""
    typed = "\n".join(random.Random(seed).choices("abcdefg", k=400)) + "\n"
    command = [sys.executable, "-m", "thorndike", "play", "connect_four", "--simulations", str(SIMULATIONS), "--json"]
    told = json.loads(subprocess.run(command, input=typed, capture_output=True, text=True, check=True).stdout)
    if not told["over"]:
        raise ValueError("the game did not come to its end")
    return told["slowest_answer_s"]


def by_itself() -> list[float]:
    """CPU-seconds of each move of whole games, compiling left out."""
    rules, player, drawn, spent = compiled(CONNECT_FOUR), td.player("trained", "connect_four"), np.random.default_rng(0), []
    player.choose(Turn(CONNECT_FOUR, rules.init(0), ()))
    for game in range(GAMES):
        position, moves = rules.init(0), []
        while len(legal := rules.legal(position)):
            if len(moves) % 2 == game % 2:
                began = time.process_time()
                action = player.choose(Turn(CONNECT_FOUR, position, tuple(moves))).action
                spent.append(time.process_time() - began)
            else:
                action = int(drawn.choice(legal))
            position = rules.step(position, action, 0, len(moves))
            moves.append(action)
    return spent


def main() -> None:
    slowest, spent = [at_the_terminal(seed) for seed in range(GAMES)], by_itself()
    row: dict[str, object] = {**origin(), "processor": processor(), "jax": jax.__version__, "simulations": SIMULATIONS}
    row |= {"terminal_slowest_s": [round(each, 4) for each in slowest], "moves": len(spent)}
    row |= {
        "cpu_s_a_move": {"mean": round(float(np.mean(spent)), 5), "median": round(float(np.median(spent)), 5), "max": round(max(spent), 5)}
    }
    RESULT.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(row))


if __name__ == "__main__":
    main()
