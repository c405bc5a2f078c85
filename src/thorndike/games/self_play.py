"""Playing against oneself: which move is made of what a search found, and the positions played as a network learns from them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from thorndike.games.board_heads import HeadTargets, head_targets, turned
from thorndike.games.game import Game
from thorndike.games.packing import packing
from thorndike.games.search import Found
from thorndike.replay.self_play import Rows
from thorndike.types import Noise, Shared


class Manners(NamedTuple):
    """How games are played."""

    temperature: float
    temperature_moves: int
    """Moves of a game that are drawn from the search's policy; later ones are its best."""
    resign_threshold: float
    """Resign below this value; -1: never."""
    resign_check_fraction: float
    """Share of the games that nobody resigns."""
    full_search_fraction: float


class Memory(NamedTuple):
    """What is known of games under way ``[B]``."""

    moves: Int[Array, " B"]
    """Made since the game began here, its opening not counted."""
    plays_on: Bool[Array, " B"]
    """Whether nobody resigns this game."""


class Moved(NamedTuple):
    """A move of each game ``[B]``."""

    memory: Memory
    action: Int[Array, " B"]
    resigns: Bool[Array, " B"]
    """Whether the mover would have resigned, but the game is played on."""


def fresh_memory(games: int) -> Memory:
    """Of games that begin."""
    return Memory(jnp.zeros((games,), jnp.int32), jnp.zeros((games,), bool))


def draw_moves(key: Key[Array, ""], steps: int, games: int, actions: int, manners: Manners) -> Noise:
    """Noise of ``steps`` moves of ``games`` games. Consumes the key."""
    key_search, key_full, key_moves, key_on = jax.random.split(key, 4)
    return {
        "search": Shared(jax.random.split(key_search, steps)),
        "full": Shared(jax.random.bernoulli(key_full, manners.full_search_fraction, (steps,))),
        "moves": jax.random.gumbel(key_moves, (steps, games, actions)),
        "plays_on": jax.random.bernoulli(key_on, manners.resign_check_fraction, (steps, games)),
    }


def move(found: Found, memory: Memory, noise: Noise, manners: Manners) -> Moved:
    """The first moves of a game are drawn, so that games differ; later ones are the best. An action beyond the game's own resigns."""
    tempered = jnp.log(jnp.maximum(found.policy, 1e-30)) / manners.temperature
    drawn = jnp.argmax(tempered + noise["moves"], axis=-1).astype(jnp.int32)
    action = jnp.where(memory.moves < manners.temperature_moves, drawn, found.action)
    plays_on = jnp.where(memory.moves == 0, noise["plays_on"], memory.plays_on)
    resigns = found.value < manners.resign_threshold
    action = jnp.where(resigns & ~plays_on, jnp.int32(found.policy.shape[-1]), action)
    return Moved(Memory(memory.moves + 1, plays_on), action, resigns & plays_on)


class Batch(NamedTuple):
    """Positions as a network sees them, and what it is to say of them ``[M, ...]``."""

    board: Float[Array, "M H W C"]
    legal: Bool[Array, "M actions"]
    policy: Float[Array, "M actions"]
    policy_weight: Float[Array, " M"]
    outcome: Float[Array, " M"]
    value_weight: Float[Array, " M"]
    ending: HeadTargets | None = None


def as_batch(game: Game, rows: Rows, symmetries: bool) -> Batch:
    """Sampled rows as the network sees them; with ``symmetries`` each way to turn the board takes an equal part of them."""
    positions = jax.vmap(packing(game).unpack)(rows.position)
    board, legal, policy = jax.vmap(game.observe)(positions), jax.vmap(game.legal)(positions), rows.policy
    ending = None if rows.ending is None else head_targets(game, rows.player, rows.ending)
    ways = len(game.symmetries) + 1
    for i, symmetry in enumerate(game.symmetries if symmetries else (), start=1):
        part = slice(i, None, ways)
        board = board.at[part].set(jax.vmap(symmetry.observation)(board[part]))
        policy, legal = (x.at[part].set(x[part][:, symmetry.actions]) for x in (policy, legal))
        ending = None if ending is None else turned(ending, part, symmetry)
    return Batch(board, legal, policy, rows.policy_weight, rows.outcome, rows.known.astype(jnp.float32), ending)


def false_resignations(rows: Rows) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """How many movers of games played on would have resigned, and how many of these did not lose, as shares of all rows."""
    would = rows.resigns & rows.known
    return jnp.mean(would.astype(jnp.float32)), jnp.mean((would & (rows.outcome > -1)).astype(jnp.float32))
