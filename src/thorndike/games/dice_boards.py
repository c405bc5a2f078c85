"""Boards of the games with chance: backgammon, and 2048, which one player plays."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from thorndike.games.face import Face
from thorndike.games.game import Board, Position, Square

_BAR, _OFF = 6, 13
"""Columns of the bar and of the pieces that are home."""
_SLIDES = ("left", "up", "right", "down")


def _column(point: int) -> Square:
    """Of a point as the first player counts them: 1 to 12 in the lower row, 13 to 24 in the upper one."""
    row, along = (1, 12 - point) if point <= 12 else (0, point - 13)
    return row, along + (along >= 6)


def _ends(position: Position, action: int) -> tuple[int, int, int]:
    """Start and end of an action as points that the mover counts (25: the bar, 0: home), and the die."""
    source, die = action // 6, action % 6 + 1
    start = 25 if source == 1 else 26 - source
    return start, max(start - die, 0), die


def _backgammon_name(position: Position, action: int) -> str:
    """``24/18``, ``bar/20``, ``6/off``; a die larger than is needed is told: ``5/off:6``."""
    if action < 6:
        return "pass"
    start, end, die = _ends(position, action)
    name = f"{'bar' if start == 25 else start}/{end or 'off'}"
    return name + (f":{die}" if start < die else "")


def _backgammon_board(position: Position, legal: Sequence[int]) -> Board:
    second = int(position.current_player) == 1
    mover, other = ("O", "X") if second else ("X", "O")

    def square(point: int) -> Square:
        """Of the mover's count."""
        if point in (0, 25):
            return (0 if second else 1), (_OFF if point == 0 else _BAR)
        return _column(25 - point if second else point)

    rows = [[""] * 14 for _ in range(2)]
    counts = np.asarray(position._board)
    for index in range(24):
        row, column = square(24 - index)
        if counts[index]:
            rows[row][column] = f"{mover if counts[index] > 0 else other}{abs(counts[index])}"
    for index, mine, column in ((24, True, _BAR), (25, False, _BAR), (26, True, _OFF), (27, False, _OFF)):
        if counts[index]:
            rows[(0 if second else 1) if mine else (1 if second else 0)][column] = f"{mover if mine else other}{abs(counts[index])}"
    clicks: dict[tuple[Square, ...], int] = {}
    buttons = {}
    for action in sorted(legal, key=lambda action: _ends(position, action)[2]):
        start, end, _ = _ends(position, action)
        click = (square(start), square(end))
        if action < 6 or click in clicks:
            buttons[_backgammon_name(position, action)] = action
        else:
            clicks[click] = action
    upper = (*map(str, range(13, 19)), "bar", *map(str, range(19, 25)), "off")
    dice = [str(die + 1) for die in np.asarray(position._playable_dice) if die >= 0]
    caption = f"upper row: 13 to 24; lower row: 12 to 1; dice left: {' '.join(dice) or 'none'}"
    return Board(tuple(map(tuple, rows)), ("", ""), upper, clicks, buttons, caption)


def _backgammon_seen(position: Position) -> Float[Array, "1 1 203"]:
    """As Tesauro 1995 ("Temporal difference learning and TD-Gammon") shows a point to a network: whether a lone checker stands there, two,
    three, and how many more; mine, then theirs. Then the bars, what is home, and the dice that are left."""
    board = position._board.astype(jnp.float32)
    sides = jnp.stack([board, -board])
    points = sides[:, :24]
    units = [points == 1, points >= 2, points >= 3, jnp.maximum(points - 3.0, 0.0) / 2.0]
    seen = jnp.stack([unit.astype(jnp.float32) for unit in units], axis=-1).reshape(-1)
    rest = jnp.concatenate([sides[0, 24:25], sides[1, 25:26], sides[0, 26:27], sides[1, 27:28]]) / jnp.array([2.0, 2.0, 15.0, 15.0])
    left = position._playable_dice[:, None] == jnp.arange(6)[None]
    dice = jnp.concatenate([jnp.any(left, axis=0).astype(jnp.float32), jnp.sum(left, dtype=jnp.float32)[None] / 4.0])
    return jnp.concatenate([seen, rest, dice])[None, None]


def _slide_name(position: Position, action: int) -> str:
    return _SLIDES[action]


def _slide_board(position: Position, legal: Sequence[int]) -> Board:
    powers = np.asarray(position._board).reshape(4, 4)
    rows = tuple(tuple(str(2 ** int(power)) if power else "" for power in row) for row in powers)
    return Board(rows, ("",) * 4, ("",) * 4, {}, {_SLIDES[action]: action for action in legal})


BACKGAMMON = Face(_backgammon_board, _backgammon_name, observe=_backgammon_seen)
PLAY_2048 = Face(_slide_board, _slide_name)
