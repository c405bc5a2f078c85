"""Othello learnt with and without the heads for ownership and score, over equal positions; then the two play each other.

python benchmarks/heads.py --output DIR    runs of each seed into DIR (those that are there stay), then benchmarks/results/heads.json

A match of each seed's pair: random openings, each played twice with colours swapped, all its games side by side. What the ownership head
has learnt is told by its loss: 0.69 is that of one that knows nothing.
"""

import argparse
import json
import time
from pathlib import Path

import thorndike as td
from connect_four import Match
from machine import origin
from side_by_side import play, run_side
from thorndike.games.othello import OTHELLO

RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "heads.json"
SETTINGS = {
    "n_steps": 8,
    "batch_size": 256,
    "gradient_steps": 8,
    "buffer_size": 100_000,
    "learning_starts": 8_192,
    "learning_rate": "linear(1e-3, 1e-4)",
    "num_simulations": 16,
    "temperature_moves": 10,
    "tower": "patches",
    "width": 128,
    "blocks": 1,
}
ARMS = {"without": {}, "with": {"ownership_coef": 1.0, "score_coef": 0.1}}
LOGGED = ("train/policy_kl", "train/value_loss", "train/ownership_loss", "train/score_loss")


def trained(folder: Path, arm: str, steps: int, seed: int) -> dict[str, object]:
    """A run of its own folder, unless it is there; and what it says of itself."""
    if not folder.exists():
        openings = {"opening_share": 0.6, "opening_plies": 12}
        settings = SETTINGS | ARMS[arm]
        found = td.train(
            "alphazero",
            "othello",
            steps=steps,
            seed=seed,
            num_envs=128,
            settings=settings,
            preset="none",
            env_kwargs=openings,
            output=folder,
        )
        facts = {"run": str(found.run), "cpu_s": round(found.cpu_s - found.compile_s, 1), "compile_s": round(found.compile_s, 1)}
        (folder / "facts.json").write_text(json.dumps(facts), encoding="utf-8")
    facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
    last = json.loads((Path(facts["run"]) / "metrics.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    return facts | {name: round(float(last[name][0]), 4) for name in LOGGED if name in last}


def main() -> None:
    """Train what is missing, play, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--games", type=int, default=100, help="of each seed's pair")
    parser.add_argument("--simulations", type=int, default=16)
    options = parser.parse_args()
    rows: dict[str, object] = {**origin(), "steps": options.steps, "settings": SETTINGS | ARMS["with"], "simulations": options.simulations}
    scores: list[float] = []
    for seed in options.seeds:
        facts = {arm: trained(options.output / f"{arm}-{seed}", arm, options.steps, seed) for arm in ARMS}
        began = time.process_time()
        sides = (run_side(arm, OTHELLO, Path(str(facts[arm]["run"])), options.simulations) for arm in ("with", "without"))
        found = play(OTHELLO, *sides, options.games, 6, seed).scores
        scores += found
        rows[f"seed {seed}"] = {
            **{arm: {name: value for name, value in facts[arm].items() if name != "run"} for arm in ARMS},
            "with against without": described(found),
            "cpu_s_match": round(time.process_time() - began, 1),
        }
        rows |= described(scores)
        RESULT.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        print(seed, json.dumps(rows), flush=True)


def described(scores: list[float]) -> dict[str, object]:
    """Of a match, seen by the first player."""
    return Match(scores.count(1.0), scores.count(0.5), scores.count(0.0)).described()


if __name__ == "__main__":
    main()
