"""A game learnt for a stated time, and how strong its checkpoints are in a pool with random moves, plain tree search and engines.

python benchmarks/curve.py go_9x9 --budget 600    into benchmarks/results/curve.json and docs/images/curve_go_9x9.png

The settings are the preset's. CPU-seconds are those of playing and learning on one core, compiling left out. Checkpoints and finished
matches are kept in a folder (--keep): with the same folder the command goes on where it was, and does not train again what was trained. The
result is written once everybody has played, and again after every further match.
A checkpoint plays the next one and the plain players, the last one the first too, the last two the engines; openings are random, and played
twice with colours swapped. Ratings are fitted to all games at once, and the random player's is set to 0.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from machine import commit, keep_row, versions
from side_by_side import Side, engine_side, mcts_side, play, together
from thorndike.algorithms.alphazero import Config, alphazero
from thorndike.environments.wrappers import chain
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.game import Game
from thorndike.games.registry import game
from thorndike.games.settings import game_settings
from thorndike.plotting.style import COLOURS, STYLE, save_figure
from thorndike.statistics.ratings import Games, fit_ratings
from thorndike.training.presets import Preset, find_preset
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm, Environment

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "curve.json"
CHECKPOINTS = (0.0, 0.125, 0.25, 0.5, 1.0)
"""Shares of the budget."""
AT_A_TIME = 4
"""Iterations of learning between two looks at the clock."""


class Plan(NamedTuple):
    """Whom a game's checkpoints meet, and how games begin."""

    opponents: tuple[str, ...]
    """Random moves first, engines last."""
    simulations: int
    """Of a checkpoint's move."""
    opening_plies: int = 4


PLANS = {
    "go_9x9": Plan(("random", "mcts:8", "gnugo:level=1"), 32),
    "chess": Plan(("random", "fairy:skill=-20,depth=1", "stockfish:skill=0,depth=1"), 16),
}


class Checkpoint(NamedTuple):
    """What plays after some training."""

    cpu_s: float
    positions: int
    actor: PyTree


def learner(rules: Game, preset: Preset, simulations: int) -> tuple[Algorithm, Environment]:
    """The preset's algorithm, which searches so many positions for a move of a match, and its games."""
    environment = game_environment(rules, preset.num_envs, game_settings(rules.id, preset.env_kwargs))
    config = Config(**{**preset.settings, "total_steps": preset.steps, "eval_simulations": simulations})
    return alphazero(config, environment.spec), environment


def train(algorithm: Algorithm, environment: Environment, preset: Preset, budget: float, seed: int, folder: Path) -> None:
    """Train for ``budget`` CPU-seconds; the checkpoints at ``CHECKPOINTS`` of it, into ``folder`` as they come."""
    bound = runner(algorithm, compiled_source(environment, algorithm, chain()), seed, range(1))
    carry, done, spent, due = bound.init(), 0, 0.0, [share * budget for share in CHECKPOINTS]
    facts: dict[str, object] = {"budget_cpu_s": budget, "seed": seed, "commit": commit(ROOT), "versions": versions(Path(sys.executable))}
    facts |= {"num_envs": preset.num_envs, "settings": {**preset.settings, **preset.env_kwargs, "total_steps": preset.steps}}
    points: list[dict[str, float]] = []
    while due:
        if spent >= due[0]:
            actor = jax.tree.map(lambda leaf: np.array(leaf[0]), algorithm.actor(carry.learner))
            np.savez(folder / f"{len(points)}.npz", *jax.tree.leaves(actor))
            points.append({"cpu_s": round(spent, 1), "positions": done * bound.steps_per_iteration})
            (folder / "training.json").write_text(json.dumps({**facts, "checkpoints": points}), encoding="utf-8")
            print(points[-1], flush=True)
            due.pop(0)
            continue
        began, compiled = time.process_time(), bound.compile_seconds()
        count = AT_A_TIME if done else max(algorithm.needs.warmup_iterations, 1)
        carry, report = bound.advance(carry, done, count)
        jax.block_until_ready(report)
        done += count
        spent += time.process_time() - began - (bound.compile_seconds() - compiled)
    print({name: round(float(value[0]), 3) for name, value in report.metrics.items()}, flush=True)


def checkpoints(algorithm: Algorithm, folder: Path) -> list[Checkpoint]:
    """What ``train`` has kept."""
    structure = jax.tree.structure(jax.eval_shape(lambda key: algorithm.actor(algorithm.init(key)), jax.random.key(0)))
    found = []
    for number, point in enumerate(json.loads((folder / "training.json").read_text(encoding="utf-8"))["checkpoints"]):
        with np.load(folder / f"{number}.npz") as leaves:
            actor = jax.tree.unflatten(structure, [leaves[name] for name in leaves.files])
        found.append(Checkpoint(point["cpu_s"], point["positions"], actor))
    return found


def sides(rules: Game, plan: Plan, algorithm: Algorithm, kept: list[Checkpoint], size: int) -> list[Side]:
    """Checkpoints, the youngest first, then the others."""
    noise = jax.tree.map(lambda x: x[0], algorithm.draw(jax.random.key(0), 1))
    observed = jax.vmap(lambda position: observed_position(rules, position))
    decide = jax.jit(lambda actor, positions: algorithm.greedy(actor, algorithm.memory(size), observed(positions), noise)[1])

    def own(actor: PyTree) -> Side:
        return Side("", together(lambda positions, number: decide(actor, positions), size))

    found = [own(each.actor)._replace(name=f"{each.cpu_s:.0f} CPU-s") for each in kept]
    for text in plan.opponents:
        found.append(mcts_side(rules, int(text.partition(":")[2] or 0), size) if is_plain(text) else engine_side(text, rules))
    return found


def is_plain(opponent: str) -> bool:
    """Whether no program of somebody else's has to be started for it."""
    return opponent == "random" or opponent.startswith("mcts:")


def pairs(kept: int, plain: int, engines: int) -> list[tuple[int, int]]:
    """Who plays whom, by place in the pool: checkpoints, then plain players, then engines, which take long for a move."""
    neighbours = [(first, first + 1) for first in range(kept - 1)]
    widest = [(0, kept - 1)] if kept > 2 else []
    others = [(own, kept + other) for other in range(plain) for own in range(kept)]
    between = [(kept + first, kept + second) for second in range(plain) for first in range(second)]
    strong = [(own, kept + plain + engine) for engine in range(engines) for own in range(max(kept - 2, 0), kept)]
    return others + strong + between + widest + neighbours


def matches(rules: Game, plan: Plan, pool: list[Side], games: int, seed: int, folder: Path) -> Iterator[list[dict]]:
    """All rows so far, after each pair. A row: games won, drawn and lost by the first of it, of those that it began, and of the others."""
    told = folder / "matches.jsonl"
    rows = [json.loads(line) for line in told.read_text(encoding="utf-8").splitlines()] if told.exists() else []
    asked = {"games": games, "seed": seed}
    rows = [row for row in rows if asked.items() <= row.items() and set(row["players"]) <= {side.name for side in pool}]
    plain = sum(map(is_plain, plan.opponents))
    for first, second in pairs(len(pool) - len(plan.opponents), plain, len(plan.opponents) - plain):
        names = [pool[first].name, pool[second].name]
        if all(row["players"] != names for row in rows):
            scores = play(rules, pool[first], pool[second], games, plan.opening_plies, seed).scores
            began = [[part.count(value) for value in (1.0, 0.5, 0.0)] for part in (scores[0::2], scores[1::2])]
            rows.append({"players": names, **asked, "first_begins": began[0], "second_begins": began[1]})
            with told.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(rows[-1]) + "\n")
            print(rows[-1], flush=True)
        yield rows


def rated(pool: list[str], kept: list[Checkpoint], rows: list[dict]) -> dict[str, object]:
    """Ratings of all, random moves at 0."""
    counts = []
    for row in rows:
        first, second = map(pool.index, row["players"])
        counts.append(Games(first, second, *row["first_begins"]))
        counts.append(Games(second, first, *reversed(row["second_begins"])))
    ratings = fit_ratings(len(pool), counts).players
    zero = ratings[pool.index("random")].elo
    told = [
        {"player": name, "elo": round(r.elo - zero), "ci95": [round(r.low - zero), round(r.high - zero)], "score": round(r.score, 3)}
        for name, r in zip(pool, ratings, strict=True)
    ]
    points = [{"cpu_s": each.cpu_s, "positions": each.positions, **rating} for each, rating in zip(kept, told, strict=False)]
    return {"checkpoints": points, "others": told[len(kept) :], "matches": rows}


def draw(name: str, row: dict) -> None:
    """Ratings of the checkpoints over CPU-seconds, the others as lines."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7, 4))
        points = row["checkpoints"]
        elo = np.array([p["elo"] for p in points], float)
        around = np.abs(np.array([p["ci95"] for p in points], float).T - elo)
        label = f"alphazero, {row['simulations']} simulations a move"
        axes.errorbar([p["cpu_s"] for p in points], elo, yerr=around, fmt="o-", capsize=3, color=COLOURS[0], label=label)
        for colour, other in zip(COLOURS[1:], row["others"], strict=False):
            axes.axhline(other["elo"], color=colour, linestyle="--", label=other["player"])
        axes.set(xlabel="CPU-seconds of training, one core", ylabel="Elo, random moves are 0")
        axes.set_title(f"{name}: {row['games_a_pair']} games a pair, 95 % intervals", fontsize=10)
        axes.legend()
        figure.tight_layout()
        save_figure(figure, ROOT / "docs" / "images" / f"curve_{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("game", choices=tuple(PLANS))
    parser.add_argument("--budget", type=float, default=600, help="CPU-seconds of training")
    parser.add_argument("--games", type=int, default=40, help="of each pair")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder of checkpoints and matches (default: runs/curve/GAME)")
    options = parser.parse_args()
    name, plan = options.game, PLANS[options.game]
    folder = options.keep or Path("runs") / "curve" / name
    folder.mkdir(parents=True, exist_ok=True)
    rules, preset = game(name), find_preset("alphazero", name)
    algorithm, environment = learner(rules, preset, plan.simulations)
    if not (folder / "training.json").exists():
        train(algorithm, environment, preset, options.budget, options.seed, folder)
    kept = checkpoints(algorithm, folder)
    pool = sides(rules, plan, algorithm, kept, options.games // 2)
    trained = json.loads((folder / "training.json").read_text(encoding="utf-8"))
    told = {key: value for key, value in trained.items() if key != "checkpoints"}
    command = f"python benchmarks/curve.py {name} --budget {trained['budget_cpu_s']:g} --games {options.games} --seed {options.seed}"
    told |= {"command": command, "games_a_pair": options.games, "opening_plies": plan.opening_plies, "simulations": plan.simulations}
    names = [side.name for side in pool]
    try:
        for rows in matches(rules, plan, pool, options.games, options.seed, folder):
            if {player for row in rows for player in row["players"]} == set(names):
                keep(name, told | rated(names, kept, rows))
    finally:
        for side in pool:
            side.close()


def keep(name: str, row: dict[str, object]) -> None:
    """Into the results, and drawn."""
    keep_row(RESULT, name, row)
    draw(name, row)


if __name__ == "__main__":
    main()
