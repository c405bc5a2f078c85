"""Rules of board games once more, slowly: what the games are held against."""

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.games.game import Game, Position

KEY = jax.random.key(0)


class Compiled:
    """A game's functions, compiled once."""

    def __init__(self, made: Game) -> None:
        """Nothing is traced yet."""
        self.game = made
        self.init = jax.jit(made.init)
        self.step = jax.jit(made.step)
        self._facts = jax.jit(lambda p: (made.legal(p), made.player(p), made.terminated(p), made.rewards(p)))

    def facts(self, position: Position) -> tuple[np.ndarray, int, bool, np.ndarray]:
        """Legal actions, who is to move, whether it is over, rewards."""
        legal, player, over, rewards = jax.device_get(self._facts(position))
        return np.flatnonzero(legal), int(player), bool(over), rewards

    def play(self, position: Position, action: int, seed: int = 0) -> Position:
        return self.step(position, jnp.int32(action), jax.random.key(seed))


class SlowOthello:
    """Square by square."""

    def __init__(self) -> None:
        """The usual beginning, ``X`` to move."""
        self.board = {(r, c): "" for r in range(8) for c in range(8)}
        self.board |= {(3, 3): "O", (4, 4): "O", (3, 4): "X", (4, 3): "X"}
        self.mover, self.passed, self.over = "X", False, False

    def flips(self, square: tuple[int, int]) -> list[tuple[int, int]]:
        found: list[tuple[int, int]] = []
        if self.board.get(square) != "":
            return found
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                line, at = [], (square[0] + down, square[1] + right)
                while self.board.get(at, "") not in ("", self.mover):
                    line.append(at)
                    at = at[0] + down, at[1] + right
                found += line if self.board.get(at) == self.mover else []
        return found

    def legal(self) -> list[str]:
        moves = [f"{'abcdefgh'[c]}{r + 1}" for r, c in self.board if self.flips((r, c))]
        return moves or ["pass"]

    def play(self, name: str) -> None:
        if name == "pass":
            self.over = self.passed
        else:
            square = int(name[1]) - 1, "abcdefgh".index(name[0])
            for turned in self.flips(square):
                self.board[turned] = self.mover
            self.board[square] = self.mover
        self.passed = name == "pass"
        self.mover = "O" if self.mover == "X" else "X"
        full = "" not in self.board.values()
        self.over = self.over or full or self.mover not in self.board.values()

    def rows(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(self.board[r, c] for c in range(8)) for r in range(8))

    def owners(self) -> list[list[int]]:
        return [[(self.board[r, c] == "X") - (self.board[r, c] == "O") for c in range(8)] for r in range(8)]

    def rewards(self) -> list[int]:
        lead = sum((piece == "X") - (piece == "O") for piece in self.board.values())
        return [int(np.sign(lead)), -int(np.sign(lead))] if self.over else [0, 0]


class SlowGo:
    """Groups by flood; no suicide; the simple ko; a board that was there before loses; area scoring, komi 7.5."""

    def __init__(self, size: int) -> None:
        """Empty, black to move."""
        self.size = size
        self.board = {(r, c): "" for r in range(size) for c in range(size)}
        self.mover, self.passes, self.repeated = "X", 0, False
        self.before = {self.key()}
        self.ko: tuple[int, int] | None = None

    def key(self) -> tuple[str, ...]:
        return tuple(self.board.values())

    def beside(self, at: tuple[int, int]) -> list[tuple[int, int]]:
        around = [(at[0] + 1, at[1]), (at[0] - 1, at[1]), (at[0], at[1] + 1), (at[0], at[1] - 1)]
        return [square for square in around if square in self.board]

    def group(self, at: tuple[int, int]) -> tuple[set[tuple[int, int]], set[tuple[int, int]]]:
        """The stones or empty squares connected with one, and the squares beside them."""
        found, border, queue = {at}, set(), [at]
        while queue:
            for other in self.beside(queue.pop()):
                if self.board[other] != self.board[at]:
                    border.add(other)
                elif other not in found:
                    found.add(other)
                    queue.append(other)
        return found, border

    def placed(self, at: tuple[int, int]) -> set[tuple[int, int]] | None:
        """What a stone captures, None where it may not be put."""
        if self.board[at] or at == self.ko:
            return None
        captured: set[tuple[int, int]] = set()
        self.board[at] = self.mover
        for other in self.beside(at):
            if self.board[other] not in ("", self.mover):
                stones, border = self.group(other)
                if all(self.board[square] for square in border):
                    captured |= stones
        alive = bool(captured) or any(self.board[square] == "" for square in self.group(at)[1])
        self.board[at] = ""
        return captured if alive else None

    def name(self, at: tuple[int, int]) -> str:
        return f"{'ABCDEFGHJKLMNOPQRST'[at[1]]}{self.size - at[0]}"

    def legal(self) -> list[str]:
        return [*(self.name(at) for at in self.board if self.placed(at) is not None), "pass"]

    def play(self, name: str) -> None:
        self.ko, other = None, "O" if self.mover == "X" else "X"
        self.passes = self.passes + 1 if name == "pass" else 0
        if name != "pass":
            at = next(square for square in self.board if self.name(square) == name)
            captured = self.placed(at) or set()
            closed = all(self.board[square] == other for square in self.beside(at))
            self.board[at] = self.mover
            for square in captured:
                self.board[square] = ""
            self.ko = next(iter(captured)) if len(captured) == 1 and closed else None
            self.repeated = self.key() in self.before
            self.before.add(self.key())
        self.mover = other

    @property
    def over(self) -> bool:
        return self.passes >= 2 or self.repeated

    def owners(self) -> list[list[int]]:
        """1 in black's area, -1 in white's."""
        beside = {at: {stone} if stone else {self.board[square] for square in self.group(at)[1]} for at, stone in self.board.items()}
        return [[(beside[r, c] == {"X"}) - (beside[r, c] == {"O"}) for c in range(self.size)] for r in range(self.size)]

    def score(self) -> float:
        """Black's area less white's, less komi."""
        return sum(map(sum, self.owners())) - 7.5

    def rewards(self) -> list[int]:
        if not self.over:
            return [0, 0]
        winner = self.mover if self.repeated else "X" if self.score() > 0 else "O"
        return [1, -1] if winner == "X" else [-1, 1]

    def rows(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(self.board[r, c] for c in range(self.size)) for r in range(self.size))


class SlowHex:
    """``X`` connects the top with the bottom, ``O`` the left with the right; the second player may swap."""

    def __init__(self) -> None:
        """Empty."""
        self.board = {(r, c): "" for r in range(11) for c in range(11)}
        self.moves, self.over = 0, False

    @property
    def mover(self) -> str:
        return "XO"[self.moves % 2]

    def legal(self) -> list[str]:
        empty = [f"{'abcdefghijk'[c]}{r + 1}" for (r, c), piece in self.board.items() if not piece]
        return empty + (["swap"] if self.moves == 1 else [])

    def play(self, name: str) -> None:
        if name == "swap":
            (r, c), _ = next((at, piece) for at, piece in self.board.items() if piece)
            self.board[r, c] = ""
            self.board[c, r] = "O"
        else:
            self.board[int(name[1:]) - 1, "abcdefghijk".index(name[0])] = self.mover
        self.over = self.connected(self.mover)
        self.moves += 1

    def connected(self, piece: str) -> bool:
        along = 0 if piece == "X" else 1
        queue = [at for at, there in self.board.items() if there == piece and at[along] == 0]
        found = set(queue)
        while queue:
            r, c = queue.pop()
            for other in ((r, c - 1), (r, c + 1), (r - 1, c), (r + 1, c), (r - 1, c + 1), (r + 1, c - 1)):
                if self.board.get(other) == piece and other not in found:
                    found.add(other)
                    queue.append(other)
        return any(at[along] == 10 for at in found)

    def rewards(self) -> list[int]:
        if not self.over:
            return [0, 0]
        return [-1, 1] if self.mover == "X" else [1, -1]

    def rows(self) -> tuple[tuple[str, ...], ...]:
        return tuple(tuple(self.board[r, c] for c in range(11)) for r in range(11))
