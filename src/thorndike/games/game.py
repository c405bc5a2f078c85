"""What a game is, and what a player is: pure functions of one position for the compiled loop, and a little for people to see it.

A position has no batch axis: ``jax.vmap`` makes batches. Player 0 moves first; rewards are always by player, never by who is to move.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

Position: TypeAlias = PyTree
"""All there is to know about a game that is being played: arrays of fixed shapes."""

Square: TypeAlias = tuple[int, int]
"""Row and column of a board, counted from the top left."""


class Symmetry(NamedTuple):
    """A way to turn or mirror the board that changes nothing about the game."""

    observation: Callable[[Float[Array, "height width channels"]], Float[Array, "height width channels"]]
    """What ``observe`` gives -> what it gives of the turned position."""
    actions: Int[np.ndarray, " actions"]
    """``policy[actions]`` of a policy on the position as it is, is that policy on the turned position."""


class Board(NamedTuple):
    """A position as people see it."""

    rows: tuple[tuple[str, ...], ...]
    """The piece on each square from the top, ``""`` where there is none: ``"X"`` and ``"O"`` (players 0 and 1), or a piece's letter."""
    row_names: tuple[str, ...]
    column_names: tuple[str, ...]
    clicks: Mapping[tuple[Square, ...], int]
    """The squares clicked one after another -> the legal action that they mean: one to place a piece, two to move one."""
    buttons: Mapping[str, int]
    """Legal actions that are no click on the board, by name: ``pass``."""
    caption: str = ""
    """What no square shows: the dice."""


class Game(NamedTuple):
    """A game of perfect information for one or two players who move in turn, as pure functions of one position.

    ``step`` of a finished position, or with an illegal action, is undefined: callers ask ``legal`` first, and begin anew themselves.
    """

    id: str
    num_actions: int
    observation_shape: tuple[int, int, int]
    """Height, width, channels."""
    max_moves: int
    """No game is longer."""
    init: Callable[[Key[Array, ""]], Position]
    """Consumes the key; only games that begin at random look at it."""
    step: Callable[[Position, Int[Array, ""], Key[Array, ""]], Position]
    """position, legal action, key -> the next position. Only games with dice look at the key."""
    legal: Callable[[Position], Bool[Array, " actions"]]
    player: Callable[[Position], Int[Array, ""]]
    """Who is to move: 0 or 1."""
    terminated: Callable[[Position], Bool[Array, ""]]
    rewards: Callable[[Position], Float[Array, " players"]]
    """What the last move earned each player; of a board game +1, 0 or -1 when it is over, and 0 before."""
    observe: Callable[[Position], Float[Array, "height width channels"]]
    """The position as the player to move sees it."""
    board: Callable[[Position], Board]
    """For people; not to be traced."""
    action_name: Callable[[Position, int], str]
    """A legal action as players of this game write it: ``d`` or ``e2e4``. Not to be traced; ``named_action`` goes the other way."""
    symmetries: tuple[Symmetry, ...] = ()
    """Others than leaving it as it is."""
    ownership: Callable[[Position], Float[Array, "height width"]] | None = None
    """Of a game that is decided by whose the squares are: of a finished position 1 where one is player 0's, -1 player 1's, 0 nobody's.

    The squares are those of ``observe``, which then must not turn the board with the mover."""
    komi: float = 0.0
    """Squares that player 1 is given for moving second, in such a game."""
    num_players: int = 2
    has_chance: bool = False
    """Whether dice are thrown, so that a search needs chance nodes."""

    @property
    def can_be_searched(self) -> bool:
        """Whether it is a game of two without dice, which is what a search looks ahead in."""
        return self.num_players == 2 and not self.has_chance


class Choice(NamedTuple):
    """A player's answer to a position."""

    action: int
    win_probability: float | None = None
    """Of the player to move, draws counted as half; None where the player does not tell."""
    visits: Mapping[int, int] | None = None
    """How often a search tried each action."""
    principal_variation: tuple[int, ...] = ()
    """The line that the player expects, beginning with ``action``."""
    resigns: bool = False
    remark: str = ""
    """What people should know: why it resigns, that it broke a rule."""


class Turn(NamedTuple):
    """What a player is asked: the position and how it came about, for engines that follow the moves."""

    game: Game
    position: Position
    moves: tuple[int, ...]
    """All actions from the beginning."""


class Player(NamedTuple):
    """Whoever answers positions: an agent, a checkpoint, random moves, a plain search, an engine of somebody else's, a person."""

    name: str
    choose: Callable[[Turn], Choice]
    """Raises UserError where the player cannot go on (an engine that died twice); a match then counts the game as not played."""
    close: Callable[[], None] = lambda: None
    """Ends what was started. A player is not asked afterwards."""
    identity: str = ""
    """What tells a player from an earlier one of the same name: of an agent its parameters, which training on changes."""


def named_action(game: Game, position: Position, name: str) -> int | None:
    """The legal action that players call ``name``, case ignored unless two differ by nothing else; None if there is no such move."""
    names = {game.action_name(position, action): action for action in map(int, np.flatnonzero(np.asarray(game.legal(position))))}
    if name in names:
        return names[name]
    alike = [action for other, action in names.items() if other.lower() == name.lower()]
    return alike[0] if len(alike) == 1 else None
