"""How well a trained policy plays backgammon: games won, and points a game, against random moves and against GNU Backgammon.

python benchmarks/backgammon.py RUN...             a row a run (or folder with its policy) into benchmarks/results/backgammon.json
python benchmarks/backgammon.py RUN --gnubg 100    beside it so many games against GNU Backgammon (Debian: gnubg), --plies throws ahead

Points are those of the rules without a doubling cube: 1, a gammon 2, a backgammon 3. The policy plays its likeliest move and does not look
ahead. Games against random moves are played side by side; against GNU Backgammon each series of throws is played twice, colours swapped,
so that its interval is that of the pairs.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import thorndike as td
from machine import origin
from thorndike.games.environment import observed_position
from thorndike.games.game import Player, Turn
from thorndike.games.match import Compiled, compiled
from thorndike.games.registry import game
from thorndike.networks.masking import FORBIDDEN, MASK
from thorndike.statistics.estimates import wilson_interval

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "backgammon.json"
BACKGAMMON = game("backgammon")
SEED, LONGEST = 2026, 5_000


def described(points: np.ndarray, pairs: bool) -> dict[str, object]:
    """Points of each game for the policy, which moves first in the even ones."""
    won = int(np.sum(points > 0))
    units = points.reshape(-1, 2).mean(axis=1) if pairs else points
    half = 1.96 * float(np.std(units, ddof=1)) / len(units) ** 0.5
    mean = float(np.mean(points))
    return {
        "games": len(points),
        "won": round(won / len(points), 4),
        "won_wilson95": [round(end, 4) for end in wilson_interval(won, len(points))],
        "points": round(mean, 3),
        "points_ci95": [round(mean - half, 3), round(mean + half, 3)],
        "gammons_won": round(float(np.mean(points >= 2)), 4),
        "gammons_lost": round(float(np.mean(points <= -2)), 4),
    }


def against_random(run: Path, games: int) -> np.ndarray:
    """Points of each game, all played side by side."""
    policy = td.load(run).policy
    actor = jax.tree.map(lambda leaf: leaf[policy.best], policy.actors)
    chances, side = policy.algorithm.probabilities, jnp.arange(games) % 2
    over = jax.vmap(BACKGAMMON.terminated)

    def move(actor: dict, carry: tuple) -> tuple:
        positions, key, points, number = carry
        key, key_random, key_step = jax.random.split(key, 3)
        obs = jax.vmap(lambda position: observed_position(BACKGAMMON, position))(positions)
        best = jnp.argmax(chances(actor, (), obs), axis=-1)
        drawn = jax.random.categorical(key_random, jnp.where(obs[MASK] > 0, 0.0, FORBIDDEN))
        action = jnp.where(jax.vmap(BACKGAMMON.player)(positions) == side, best, drawn).astype(jnp.int32)
        after = jax.vmap(BACKGAMMON.step)(positions, action, jax.random.split(key_step, games))
        ended = over(positions)
        won = jax.vmap(lambda position, seat: BACKGAMMON.rewards(position)[seat])(after, side)
        points = jnp.where(~ended & over(after), won, points)

        def keep(old: jax.Array, new: jax.Array) -> jax.Array:
            return jnp.where(ended.reshape((games,) + (1,) * (old.ndim - 1)), old, new)

        return jax.tree.map(keep, positions, after), key, points, number + 1

    # The parameters are an argument: the program of one run serves all of its size.
    def play(actor: dict, key: jax.Array) -> jax.Array:
        key_begin, key = jax.random.split(key)
        begun = jax.vmap(BACKGAMMON.init)(jax.random.split(key_begin, games))
        carry = begun, key, jnp.zeros(games), jnp.int32(0)
        return jax.lax.while_loop(lambda carry: ~jnp.all(over(carry[0])) & (carry[3] < LONGEST), lambda carry: move(actor, carry), carry)[2]

    return np.asarray(jax.jit(play)(actor, jax.random.key(SEED)))


def against(rules: Compiled, policy: Player, other: Player, games: int) -> np.ndarray:
    """Points of each game, one after another."""
    found = []
    for number in range(games):
        seats, seed = ((policy, other), SEED + number // 2) if number % 2 == 0 else ((other, policy), SEED + number // 2)
        position, moves, earlier = rules.init(seed), [], []
        while len(legal := rules.legal(position)):
            choice = seats[rules.mover(position)].choose(Turn(BACKGAMMON, position, tuple(moves), tuple(earlier)))
            if choice.resigns or choice.action not in legal:
                raise ValueError(f"game {number}, move {len(moves) + 1}: {choice.remark}")
            earlier.append(position)
            position = rules.step(position, choice.action, seed, len(moves))
            moves.append(choice.action)
        found.append(rules.rewards(position)[number % 2])
        if number % 10 == 9:
            print(f"{number + 1} games: {np.mean(np.array(found) > 0):.3f} won, {np.mean(found):.3f} points", flush=True)
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--games", type=int, default=1000, help="against random moves")
    parser.add_argument("--gnubg", type=int, default=0, help="against GNU Backgammon")
    parser.add_argument("--plies", type=int, default=0)
    parser.add_argument("--name", help="what the row is called, where there is one run (default: its folder's name)")
    options = parser.parse_args()
    for run in options.runs:
        record = json.loads((run / "run.json").read_text(encoding="utf-8")) if (run / "run.json").exists() else {}
        row: dict[str, object] = {**origin()} | {name: record.get(name) for name in ("steps_done", "cpu_s", "compile_s", "seed")}
        if options.games:
            row["random"] = described(against_random(run, options.games), pairs=False)
            print(run.name, row["random"], flush=True)
        if options.gnubg:
            began, opponent = time.process_time(), f"gnubg:plies={options.plies}"
            policy, other = td.player(run, BACKGAMMON), td.player(opponent, BACKGAMMON)
            try:
                points = against(compiled(BACKGAMMON), policy, other, options.gnubg)
            finally:
                other.close()
            row[opponent] = described(points, pairs=True)
            print(run.name, row[opponent], f"({time.process_time() - began:.0f} CPU-s)", flush=True)
        results = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
        name = options.name or run.name
        results[name] = results.get(name, {}) | row
        RESULT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
