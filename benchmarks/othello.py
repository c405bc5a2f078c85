"""A trained policy of Othello against GRhino's engine, its games played side by side.

python benchmarks/othello.py RUN --simulations 400 --level 3    200 games, into benchmarks/results/othello.json (a row a run and setting)

Openings are random, each played twice with colours swapped. Needs `gtp-rhino` (Debian's package grhino).
"""

import argparse
import json
import resource
import time
from pathlib import Path

from connect_four import Match
from machine import keep_row, origin
from side_by_side import engine_side, play, run_side
from thorndike.games.othello import OTHELLO

RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "othello.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run, or a folder that holds an exported policy")
    parser.add_argument("--simulations", type=int, default=400)
    parser.add_argument("--level", type=int, default=3, help="of GRhino, 1 to 5")
    parser.add_argument("--games", type=int, default=200)
    parser.add_argument("--opening-plies", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", help="what the row is called (default: the run's folder)")
    options = parser.parse_args()
    ours = run_side("ours", OTHELLO, options.run, options.simulations)
    rhino = engine_side(f"rhino:level={options.level}", OTHELLO)
    began = time.process_time()
    played = play(OTHELLO, ours, rhino, options.games, options.opening_plies, options.seed)
    spent = time.process_time() - began
    rhino.close()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    match = Match(played.scores.count(1.0), played.scores.count(0.5), played.scores.count(0.0))
    record_file = options.run / "run.json"
    record = json.loads(record_file.read_text(encoding="utf-8")) if record_file.exists() else {}
    row = {name: record.get(name) for name in ("steps_done", "cpu_s")}
    row |= {"level": options.level, "simulations": options.simulations, "opening_plies": options.opening_plies, "seed": options.seed}
    row |= match.described()
    # All our games are searched together; compiling is in our seconds.
    row |= {"cpu_s_ours": round(spent, 1), "cpu_s_rhino": round(used.ru_utime + used.ru_stime, 1)}
    name = f"{options.name or options.run.name}, {options.simulations} simulations, level {options.level}"
    keep_row(RESULT, name, {**row, **origin()})
    print(json.dumps(row))


if __name__ == "__main__":
    main()
