"""2048: points and largest tiles of trained policies, beside random moves.

python benchmarks/play_2048.py RUN --games 1000     every seed of a run, and random moves, into benchmarks/results/2048.json
python benchmarks/play_2048.py --games 1000         random moves alone

All games are played side by side to their end, by the policy's likeliest legal move. The interval is that of the mean over seeds
(Student's) where there are several, else over games.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from scipy.special import stdtrit

import thorndike as td
from machine import keep_row, origin
from thorndike.games.environment import observed_position
from thorndike.games.game import Position
from thorndike.games.registry import game
from thorndike.networks.masking import FORBIDDEN, MASK

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "2048.json"
RULES = game("2048")
SEED, LONGEST = 2048, 20_000
TILES = (256, 512, 1024, 2048)
Choose = Callable[[PyTree, PyTree, jax.Array], jax.Array]
"""actor, observations, key -> moves."""


def played(choose: Choose, actor: PyTree, games: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and largest tile of each game."""
    over = jax.vmap(RULES.terminated)

    def move(carry: tuple) -> tuple[Position, jax.Array, jax.Array, jax.Array]:
        positions, key, points, number = carry
        key, key_choose, key_step = jax.random.split(key, 3)
        obs = jax.vmap(lambda position: observed_position(RULES, position))(positions)
        after = jax.vmap(RULES.step)(positions, choose(actor, obs, key_choose), jax.random.split(key_step, games))
        ended = over(positions)
        points = points + jnp.where(ended, 0.0, jax.vmap(RULES.rewards)(after)[:, 0])

        def keep(old: jax.Array, new: jax.Array) -> jax.Array:
            return jnp.where(ended.reshape((games,) + (1,) * (old.ndim - 1)), old, new)

        return jax.tree.map(keep, positions, after), key, points, number + 1

    def play(actor: PyTree, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_begin, key = jax.random.split(key)
        begun = jax.vmap(RULES.init)(jax.random.split(key_begin, games))
        carry = begun, key, jnp.zeros(games), jnp.int32(0)
        carry = jax.lax.while_loop(lambda carry: ~jnp.all(over(carry[0])) & (carry[3] < LONGEST), move, carry)
        return carry[2], jnp.max(carry[0]._board, axis=1)

    points, powers = jax.jit(play)(actor, jax.random.key(SEED))
    return np.asarray(points), 2 ** np.asarray(powers)


def at_random(actor: PyTree, obs: PyTree, key: jax.Array) -> jax.Array:
    return jax.random.categorical(key, jnp.where(obs[MASK] > 0, 0.0, FORBIDDEN)).astype(jnp.int32)


def described(points: np.ndarray, tiles: np.ndarray) -> dict[str, object]:
    """Of one player's games."""
    reached = {str(tile): round(float(np.mean(tiles >= tile)), 4) for tile in TILES}
    return {
        "games": len(points),
        "mean_score": round(float(np.mean(points)), 1),
        "best_score": int(points.max()),
        "share_reaching": reached,
    }


def of_run(run: Path, games: int) -> dict[str, object]:
    """Every seed of a run."""
    loaded = td.load(run)
    rows, means = [], []
    for policy in loaded.policy.seeds:
        chances, wrapper, statistics = policy.algorithm.probabilities, policy.wrapper, jax.tree.map(lambda x: x[0], policy.statistics)

        def choose(actor: PyTree, obs: PyTree, key: jax.Array) -> jax.Array:
            return jnp.argmax(chances(actor, (), wrapper.init(statistics, obs)[1]), axis=-1).astype(jnp.int32)  # noqa: B023

        points, tiles = played(choose, jax.tree.map(lambda leaf: leaf[0], policy.actors), games)
        rows.append(described(points, tiles))
        means.append(float(np.mean(points)))
        print(run.name, "seed", policy.first, rows[-1], flush=True)
    units = np.array(means) if len(means) > 1 else points
    half = float(stdtrit(len(units) - 1, 0.975) * np.std(units, ddof=1) / len(units) ** 0.5)
    record = json.loads((run / "run.json").read_text(encoding="utf-8"))
    told = {name: record.get(name) for name in ("steps_done", "cpu_s", "compile_s", "seed", "config")}
    told |= {"trained": record.get("command"), "trained_at_commit": record.get("git_commit")}
    mean = float(np.mean(means))
    return {**told, "mean_score": round(mean, 1), "ci95": [round(mean - half, 1), round(mean + half, 1)], "seeds": rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path)
    parser.add_argument("--games", type=int, default=1000, help="of each seed")
    parser.add_argument("--name", help="what the row is called (default: the folder's name)")
    parser.add_argument("--try", dest="only_look", action="store_true", help="print, and keep nothing")
    options = parser.parse_args()
    rows = {"random moves": described(*played(at_random, (), options.games))} if not options.only_look else {}
    if options.run is not None:
        rows[options.name or options.run.name] = of_run(options.run, options.games)
    if options.only_look:
        return
    for name, row in rows.items():
        keep_row(RESULT, name, {**origin(), **row})


if __name__ == "__main__":
    main()
