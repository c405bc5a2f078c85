"""What a search could take over from the one before it: the share of its visits that lie below the move that is then played.

python benchmarks/tree_reuse.py     into benchmarks/results/tree_reuse.json: Connect Four's trained policy, on games with itself

mctx begins every search with an empty tree. A tree that is kept is at most worth the visits below the move played; against somebody else
the reply divides them once more.
"""

import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import thorndike as td
from machine import origin
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import observed_position, opening
from thorndike.games.search import SearchSettings, search
from thorndike.games.trained import trained_run

RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "tree_reuse.json"
GAMES, MOVES, OPENING = 64, 24, 4


def shares(kind: str, simulations: int, explore: bool) -> np.ndarray:
    """Of every position searched in ``GAMES`` games: the share of the visits below the move that was played."""
    policy = td.load(trained_run(CONNECT_FOUR.id)).policy
    actor = jax.tree.map(lambda leaf: leaf[policy.best], policy.actors)
    settings = SearchSettings(kind, simulations)

    def evaluate(params: jax.Array, positions: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        obs = jax.vmap(lambda position: observed_position(CONNECT_FOUR, position))(positions)
        chances = policy.algorithm.probabilities(actor, (), obs)
        return jnp.log(jnp.maximum(chances, 1e-12)), policy.algorithm.value(actor, obs)

    def move(positions: jax.Array, key: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        found = search(CONNECT_FOUR, evaluate, settings, (), positions, key, explore)
        over = jax.vmap(CONNECT_FOUR.terminated)(positions)
        after = jax.vmap(lambda position, action: CONNECT_FOUR.step(position, action, key))(positions, found.action)
        share = jnp.take_along_axis(found.visits, found.action[:, None], axis=1)[:, 0] / simulations
        kept = jax.tree.map(lambda old, new: jnp.where(over.reshape((GAMES,) + (1,) * (old.ndim - 1)), old, new), positions, after)
        return kept, (share, ~over)

    @jax.jit
    def play(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_begin, key = jax.random.split(key)
        begun = jax.vmap(lambda key: opening(CONNECT_FOUR, key, 1.0, OPENING))(jax.random.split(key_begin, GAMES))
        return jax.lax.scan(move, begun, jax.random.split(key, MOVES))[1]

    share, goes_on = (np.asarray(x) for x in play(jax.random.key(0)))
    return share[goes_on]


def main() -> None:
    results = {}
    for kind, simulations, explore in (("gumbel", 32, True), ("puct", 32, True), ("gumbel", 200, False), ("puct", 200, False)):
        began = time.process_time()
        found = shares(kind, simulations, explore)
        quarter, half, three = np.quantile(found, [0.25, 0.5, 0.75])
        name = f"{kind}, {simulations} simulations, {'self-play' if explore else 'for strength'}"
        results[name] = {**origin(), "positions": len(found), "mean": round(float(np.mean(found)), 3)}
        results[name] |= {"quartiles": [round(float(x), 3) for x in (quarter, half, three)]}
        print(name, results[name], f"({time.process_time() - began:.0f} CPU-s)", flush=True)
        RESULT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
