"""A ring of positions from self-play ``[N, B]`` (N steps of B games side by side), whose outcomes are filled in when games end.

A row waits until its game is over: only then is its value known. Until then what it says of the policy can be learnt from already.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8, Int32, Key


class Ending(NamedTuple):
    """How the board looked when games had ended, with any leading axes. Each row has room for one, filled where a game ended."""

    owner: Int8[Array, "*rows H W"]
    """Whose each square was: 1 player 0's, -1 player 1's, 0 nobody's."""
    counts: Bool[Array, "*rows"]
    """Whether the squares decided the game."""
    step: Int32[Array, "*rows"]
    """The step of the ring in which the row's game ended, once that is known."""


class Rows(NamedTuple):
    """Positions in which somebody moved, with any leading axes."""

    position: Int32[Array, "*rows words"]
    """Packed."""
    player: Int8[Array, "*rows"]
    """Who was to move."""
    policy: Float[Array, "*rows actions"]
    """What the search made of it."""
    policy_weight: Float[Array, "*rows"]
    """0 where the search was too short to teach a policy."""
    outcome: Float[Array, "*rows"]
    """What the game earned the player who was to move."""
    known: Bool[Array, "*rows"]
    """Whether the outcome is known."""
    resigns: Bool[Array, "*rows"]
    """Whether the mover would have resigned a game that was played on."""
    ending: Ending | None = None
    """Of the board, where something is to be learnt from it."""


class SelfPlayBuffer(NamedTuple):
    """The ring ``[N, B, ...]``."""

    rows: Rows
    position: Int[Array, ""]
    """The step written next, in ``[0, N)``."""
    size: Int[Array, ""]
    """Steps stored, at most N."""


def init_self_play(steps: int, games: int, words: int, actions: int, board: tuple[int, int] | None = None) -> SelfPlayBuffer:
    """An empty ring for ``steps`` steps of ``games`` games; with a height and width, it keeps how the ``board`` looked in the end."""
    lead = (steps, games)
    nothing = None if board is None else Ending(jnp.zeros((*lead, *board), jnp.int8), jnp.zeros(lead, bool), jnp.zeros(lead, jnp.int32))
    rows = Rows(
        position=jnp.zeros((*lead, words), jnp.int32),
        player=jnp.zeros(lead, jnp.int8),
        policy=jnp.zeros((*lead, actions), jnp.float32),
        policy_weight=jnp.zeros(lead, jnp.float32),
        outcome=jnp.zeros(lead, jnp.float32),
        known=jnp.zeros(lead, bool),
        resigns=jnp.zeros(lead, bool),
        ending=nothing,
    )
    return SelfPlayBuffer(rows, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def add_self_play(buffer: SelfPlayBuffer, new: Rows, reward: Float[Array, "T B"], done: Bool[Array, "T B"], longest: int) -> SelfPlayBuffer:
    """Write ``T`` steps over the oldest ones and tell the outcomes of the games that ended to all their rows.

    ``reward`` is what each step's mover earned by it, ``longest`` how many steps a game can have. ``N`` must be a multiple of ``T`` and at
    least ``T + longest``; the outcomes in ``new``, and where its endings lie, are not looked at.
    """
    steps, length = buffer.rows.player.shape[0], new.player.shape[0]
    rows = jax.tree.map(
        lambda stored, incoming: jax.lax.dynamic_update_slice_in_dim(stored, incoming.astype(stored.dtype), buffer.position, axis=0),
        buffer.rows,
        new._replace(outcome=jnp.zeros_like(new.outcome), known=jnp.zeros_like(new.known)),
    )
    reach = min(steps, length + longest)
    window = (buffer.position + length - reach + jnp.arange(reach)) % steps
    earlier = reach - length
    ends = jnp.concatenate([jnp.zeros((earlier, done.shape[1]), bool), done])
    earned = jnp.concatenate([jnp.zeros((earlier, done.shape[1])), reward])
    player, outcome, known = rows.player[window], rows.outcome[window], rows.known[window]
    said = outcomes(player, earned, ends)
    told = ~known & said.known
    rows = rows._replace(
        outcome=rows.outcome.at[window].set(jnp.where(told, said.outcome, outcome)), known=rows.known.at[window].set(known | told)
    )
    if rows.ending is not None:
        ended = window[jax.lax.cummin(jnp.where(ends, jnp.arange(reach)[:, None], reach - 1), reverse=True)]
        where = jnp.where(told, ended, rows.ending.step[window])
        rows = rows._replace(ending=rows.ending._replace(step=rows.ending.step.at[window].set(where)))
    return SelfPlayBuffer(rows, (buffer.position + length) % steps, jnp.minimum(buffer.size + length, steps))


class Outcomes(NamedTuple):
    """What games earned, seen from each of their rows ``[T, B]``."""

    outcome: Float[Array, "T B"]
    known: Bool[Array, "T B"]


def outcomes(player: Int8[Array, "T B"], reward: Float[Array, "T B"], done: Bool[Array, "T B"]) -> Outcomes:
    """Backwards from the ends of games of two: each row earned what its mover earned in the end, or the other's loss."""

    def back(carry: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], Outcomes]:
        of_first, known = carry
        player, reward, done = row
        sign = jnp.where(player == 0, 1.0, -1.0)
        of_first, known = jnp.where(done, sign * reward, of_first), known | done
        return (of_first, known), Outcomes(sign * of_first, known)

    nothing = jnp.zeros(player.shape[1:]), jnp.zeros(player.shape[1:], bool)
    return jax.lax.scan(back, nothing, (player, reward, done), reverse=True)[1]


def sample_self_play(buffer: SelfPlayBuffer, key: Key[Array, ""], count: int) -> Rows:
    """Draw ``count`` rows uniformly with replacement, each with the ending of its game. Consumes the key.

    The cost does not grow with the ring's size.
    """
    steps, games = buffer.rows.player.shape
    # A remainder of 32 random bits is biased by less than size / 2**32.
    drawn = (jax.random.bits(key, (count,), jnp.uint32) % (buffer.size * games).astype(jnp.uint32)).astype(jnp.int32)
    oldest = (buffer.position - buffer.size) % steps
    step, game = (oldest + drawn // games) % steps, drawn % games
    rows, kept = jax.tree.map(lambda x: x[step, game], buffer.rows), buffer.rows.ending
    if kept is None:
        return rows
    end = rows.ending.step
    return rows._replace(ending=Ending(kept.owner[end, game], kept.counts[end, game] & rows.known, end))
