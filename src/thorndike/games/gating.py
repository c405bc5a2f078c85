"""A gate before self-play: what was learnt since plays only once it has won a match against what plays (Silver et al. 2017, AlphaGo Zero).

The match is part of the compiled program. Its openings are random, and each is played twice, with colours swapped.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.games.environment import opening
from thorndike.games.game import Game, Position
from thorndike.types import Metrics

Decide: TypeAlias = Callable[[PyTree, Position, Key[Array, ""]], Int[Array, " B"]]
"""parameters, positions ``[B]``, key -> moves."""
_OPENING_PLIES = 8
"""At most so many random moves begin a game, and no more than a quarter of the longest game's."""


class GateSettings(NamedTuple):
    """When there is a match, and what is won by it."""

    every: int
    """Iterations between two matches; 0: no gate."""
    games: int
    """Of a match; an odd number is made even by one more."""
    threshold: float
    """Share of the points that the candidate needs, a draw counted as half."""


class Gate(NamedTuple):
    """What has passed."""

    best: PyTree
    """The parameters that play."""
    score: Float[Array, ""]
    """What the latest candidate made; 0 before there was one."""
    passed: Int[Array, ""]
    """Candidates that passed so far."""


def closed_gate(settings: GateSettings, params: PyTree) -> Gate | None:
    """A gate that nothing has passed but these parameters, of which it keeps a copy; None where nothing is gated."""
    return Gate(jax.tree.map(jnp.copy, params), jnp.zeros(()), jnp.zeros((), jnp.int32)) if settings.every else None


def try_gate(
    game: Game,
    decide: Decide,
    settings: GateSettings,
    gate: Gate | None,
    candidate: PyTree,
    iteration: Int[Array, ""],
    key: Key[Array, ""],
) -> tuple[Gate | None, Metrics]:
    """Where a match is due, the candidate plays it, and passes or not; and what is logged. Consumes the key."""
    if gate is None:
        return None, {}
    # The match is told too: where seeds are vmapped both branches of a condition are computed.
    due = iteration % settings.every == 0
    score = jax.lax.cond(
        due, lambda: match_score(game, decide, candidate, gate.best, settings.games, due, key), lambda: jnp.zeros_like(gate.score)
    )
    passes = due & (score >= settings.threshold)
    best = jax.tree.map(lambda new, old: jnp.where(passes, new, old), candidate, gate.best)
    score, passed = jnp.where(due, score, gate.score), gate.passed + passes
    return Gate(best, score, passed), {"train/gate_score": score, "train/gates_passed": passed.astype(jnp.float32)}


def match_score(
    game: Game, decide: Decide, first: PyTree, second: PyTree, games: int, due: Bool[Array, ""], key: Key[Array, ""]
) -> Float[Array, ""]:
    """The share of the points that ``first`` makes against ``second``; unless it is ``due``, no move is made. Consumes the key.

    A row of games is moved by one side, the other by the other, and at the next ply the other way round; where a player moves twice, a
    game waits for one ply.
    """
    key_begin, key_play = jax.random.split(key)
    begun = jax.vmap(lambda one: opening(game, one, 1.0, min(_OPENING_PLIES, game.max_moves // 4)))(
        jax.random.split(key_begin, -(-games // 2))
    )
    positions = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), begun)
    over, mover = jax.vmap(jax.vmap(game.terminated)), jax.vmap(jax.vmap(game.player))
    # In the first row `first` makes the first move after the opening, in the second row `second` does.
    side_of_first = jnp.stack([mover(positions)[0], 1 - mover(positions)[0]])
    sides = jax.tree.map(lambda one, other: jnp.stack([one, other]), first, second)

    def step(position: Position, action: Int[Array, ""], goes: Bool[Array, ""], key: Key[Array, ""]) -> Position:
        return jax.tree.map(lambda new, old: jnp.where(goes, new, old), game.step(position, action, key), position)

    def ply(carry: tuple[Position, Int[Array, ""]]) -> tuple[Position, Int[Array, ""]]:
        positions, number = carry
        odd = number % 2 == 1
        movers = jax.tree.map(lambda leaf: jnp.where(odd, leaf[::-1], leaf), sides)
        key_decide, key_step = jax.random.split(jax.random.fold_in(key_play, number))
        actions = jax.lax.map(lambda row: decide(*row), (movers, positions, jax.random.split(key_decide)))
        is_first = (jnp.arange(2) == 0)[:, None] ^ odd
        goes = ~over(positions) & ((mover(positions) == side_of_first) == is_first)
        keys = jax.random.split(key_step, actions.shape)
        return jax.vmap(jax.vmap(step))(positions, actions, goes, keys), number + 1

    last, _ = jax.lax.while_loop(lambda carry: due & jnp.any(~over(carry[0])), ply, (positions, jnp.int32(0)))
    earned = jnp.take_along_axis(jax.vmap(jax.vmap(game.rewards))(last), side_of_first[..., None], axis=-1)
    return jnp.mean((1.0 + jnp.sign(earned)) / 2.0)
