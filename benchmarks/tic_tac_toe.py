"""Tic-tac-toe learnt from nothing by a preset, then every line that its answers leave open, as either side.

python benchmarks/tic_tac_toe.py alphazero             into benchmarks/results/tic_tac_toe.json (a row a learner and seed)
python benchmarks/tic_tac_toe.py ppo --seeds 3 --seed 1    several agents side by side
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import thorndike as td
from machine import keep_row, origin

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "tic_tac_toe.json"
SIMULATIONS = {"alphazero": (0, 64), "muzero": (0, 64), "ppo": (0,)}
"""0: the network alone."""


def walked(run: Path, simulations: int, seed: int) -> dict[str, object]:
    """Lines won, drawn and lost; and the share of positions in which the move keeps the value."""
    # The slow Python that the tests walk through.
    sys.path.insert(0, str(ROOT / "tests"))
    import tic_tac_toe_lines as lines

    choose = lines.chooser(run, simulations, seed)
    first, second = (lines.walk(choose, agent)._asdict() for agent in (0, 1))
    return {"first": first, "second": second, "keeps_the_value": round(lines.optimal_share(choose), 4)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=tuple(SIMULATIONS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as output:
        trained = td.train(options.algorithm, "tic_tac_toe", seed=options.seed, seeds=options.seeds, output=output)
        row: dict[str, object] = {**origin(), "seed": options.seed, "seeds": options.seeds, "steps": trained.steps}
        row |= {"cpu_s": round(trained.cpu_s, 1), "compile_s": round(trained.compile_s, 1)}
        for count in SIMULATIONS[options.algorithm]:
            row[f"{count} simulations"] = [walked(trained.run, count, seed) for seed in range(options.seeds)]
    keep_row(RESULT, f"{options.algorithm}, {options.seeds} of seed {options.seed}", row)
    print(json.dumps(row))


if __name__ == "__main__":
    main()
