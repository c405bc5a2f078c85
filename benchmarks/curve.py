"""A game learnt for a stated time, and how strong its checkpoints are in a pool with random moves, plain tree search and an engine.

python benchmarks/curve.py go_9x9 --budget 90    into benchmarks/results/curve.json and docs/images/curve_go_9x9.png

CPU-seconds are those of playing and learning on one core, compiling left out. Everybody plays everybody, from random openings
that are played twice with colours swapped; ratings are fitted to all games at once, and the random player's is set to 0.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from side_by_side import Side, engine_side, mcts_side, play, together
from thorndike.algorithms.alphazero import Config, alphazero
from thorndike.environments.wrappers import chain
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.game import Game
from thorndike.games.registry import game
from thorndike.games.settings import GameSettings
from thorndike.plotting.style import COLOURS, STYLE, save_figure
from thorndike.statistics.ratings import Games, fit_ratings
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "curve.json"
CHECKPOINTS = (0.0, 0.25, 0.5, 1.0)
"""Shares of the budget."""
SHARED = {"num_simulations": 16, "fast_simulations": 6, "full_search_fraction": 0.5, "eval_simulations": 32, "gradient_steps": 8}
SHARED |= {"n_steps": 8, "batch_size": 256, "learning_rate": "linear(1e-3, 3e-4)", "blocks": 1, "buffer_size": 60_000}


class Plan(NamedTuple):
    """How a game is learnt, and whom its checkpoints meet."""

    games: int
    """Side by side."""
    settings: dict[str, object]
    opponents: tuple[str, ...]
    opening_plies: int
    expected: int
    """Positions that the budget is about enough for, by which the learning rate falls."""


PLANS = {
    "go_9x9": Plan(
        64,
        {**SHARED, "tower": "patches", "width": 128, "learning_starts": 5_000, "temperature_moves": 12},
        ("random", "mcts:4", "gnugo:level=1"),
        4,
        120_000,
    ),
}


class Checkpoint(NamedTuple):
    """What plays after some training."""

    cpu_s: float
    positions: int
    actor: PyTree


def learnt(rules: Game, plan: Plan, budget: float, seed: int) -> tuple[Algorithm, list[Checkpoint]]:
    """Train for ``budget`` CPU-seconds; the checkpoints at ``CHECKPOINTS`` of it."""
    environment = game_environment(rules, plan.games, GameSettings(opening_share=0.5, opening_plies=16))
    algorithm = alphazero(Config(**plan.settings, total_steps=plan.expected), environment.spec)
    bound = runner(algorithm, compiled_source(environment, algorithm, chain()), seed, range(1))
    carry, done, spent, kept = bound.init(), 0, 0.0, []
    due = [share * budget for share in CHECKPOINTS]
    rounds = iteration_counts(algorithm.needs.warmup_iterations)
    while due:
        if spent >= due[0]:
            actor = jax.tree.map(lambda leaf: np.array(leaf[0]), algorithm.actor(carry.learner))
            kept.append(Checkpoint(round(spent, 1), done * bound.steps_per_iteration, actor))
            print(rules.id, kept[-1][:2], flush=True)
            due.pop(0)
            continue
        began, compiled = time.process_time(), bound.compile_seconds()
        count = next(rounds)
        carry, report = bound.advance(carry, done, count)
        jax.block_until_ready(report)
        done += count
        spent += time.process_time() - began - (bound.compile_seconds() - compiled)
    print({name: round(float(value[0]), 3) for name, value in report.metrics.items()}, flush=True)
    return algorithm, kept


def iteration_counts(warmup: int) -> Iterator[int]:
    """The warm-up, then a few iterations at a time."""
    yield max(warmup, 1)
    while True:
        yield 4


def sides(rules: Game, plan: Plan, algorithm: Algorithm, kept: list[Checkpoint], size: int) -> list[Side]:
    """Checkpoints, weakest first, then the others."""
    noise = jax.tree.map(lambda x: x[0], algorithm.draw(jax.random.key(0), 1))
    observed = jax.vmap(lambda position: observed_position(rules, position))
    decide = jax.jit(lambda actor, positions: algorithm.greedy(actor, algorithm.memory(size), observed(positions), noise)[1])

    def own(actor: PyTree) -> Side:
        return Side("", together(lambda positions, number: decide(actor, positions), size))

    found = [own(each.actor)._replace(name=f"{each.cpu_s:.0f} CPU-s") for each in kept]
    for text in plan.opponents:
        is_plain = text == "random" or text.startswith("mcts:")
        found.append(mcts_side(rules, int(text.partition(":")[2] or 0), size) if is_plain else engine_side(text, rules))
    return found


def measure(name: str, budget: float, games: int, seed: int) -> dict[str, object]:
    """Train, play, rate."""
    rules, plan = game(name), PLANS[name]
    algorithm, kept = learnt(rules, plan, budget, seed)
    pool, matches, rows = sides(rules, plan, algorithm, kept, games // 2), [], []
    for first in range(len(pool)):
        for second in range(first + 1, len(pool)):
            scores = play(rules, pool[first], pool[second], games, plan.opening_plies, seed).scores
            for begins in (0, 1):
                of = [score if begins == 0 else 1 - score for score in scores[begins::2]]
                pair = (first, second) if begins == 0 else (second, first)
                matches.append(Games(*pair, of.count(1.0), of.count(0.5), of.count(0.0)))
            counts = {"won": scores.count(1.0), "drawn": scores.count(0.5), "lost": scores.count(0.0)}
            rows.append({"players": [pool[first].name, pool[second].name], **counts})
            print(rows[-1], flush=True)
    for side in pool:
        side.close()
    rated = fit_ratings(len(pool), matches)
    zero = rated.players[len(kept)].elo
    ratings = [
        {"player": side.name, "elo": round(r.elo - zero), "ci95": [round(r.low - zero), round(r.high - zero)], "score": round(r.score, 3)}
        for side, r in zip(pool, rated.players, strict=True)
    ]
    checkpoints = [{"cpu_s": each.cpu_s, "positions": each.positions, **rating} for each, rating in zip(kept, ratings, strict=False)]
    settings = {"budget_cpu_s": budget, "games_a_pair": games, "seed": seed, "num_envs": plan.games, "settings": plan.settings}
    return {**settings, "checkpoints": checkpoints, "others": ratings[len(kept) :], "matches": rows}


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
        axes.errorbar(
            [p["cpu_s"] for p in points], elo, yerr=around, fmt="o-", capsize=3, color=COLOURS[0], label="alphazero, 32 simulations"
        )
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
    parser.add_argument("--budget", type=float, default=90, help="CPU-seconds of training")
    parser.add_argument("--games", type=int, default=16, help="of each pair")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    results = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
    results[options.game] = measure(options.game, options.budget, options.games, options.seed)
    RESULT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    draw(options.game, results[options.game])


if __name__ == "__main__":
    main()
