"""Tic-tac-toe and Connect Four: the rules against slow Python, symmetries, names there and back, names of games."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.games.game import Game, named_action
from thorndike.games.registry import OWN_GAMES, game

SIZES = {"tic_tac_toe": (3, 3, 3), "connect_four": (6, 7, 4)}
"""Rows, columns, how many in a row."""
pytestmark = pytest.mark.parametrize("id", list(SIZES))
GAMES = 200


class SlowGame:
    """The rules, once more: a board of numbers, lines counted square by square."""

    def __init__(self, id: str) -> None:
        """An empty board."""
        self.falls = id == "connect_four"
        self.rows, self.columns, self.in_a_row = SIZES[id]
        self.board = [[-1] * self.columns for _ in range(self.rows)]
        self.moves = 0

    def legal(self) -> list[bool]:
        """By action."""
        if self.falls:
            return [self.board[0][column] == -1 for column in range(self.columns)]
        return [self.board[i // self.columns][i % self.columns] == -1 for i in range(self.rows * self.columns)]

    def step(self, action: int) -> None:
        """The mover's piece falls down its column, or stays where it is put."""
        row, column = (0, action) if self.falls else divmod(action, self.columns)
        while self.falls and row + 1 < self.rows and self.board[row + 1][column] == -1:
            row += 1
        self.board[row][column] = self.moves % 2
        self.moves += 1

    def winner(self) -> int | None:
        """Whoever has a line."""
        for row in range(self.rows):
            for column in range(self.columns):
                for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
                    line = [(row + i * down, column + i * right) for i in range(self.in_a_row)]
                    if all(0 <= r < self.rows and 0 <= c < self.columns for r, c in line):
                        pieces = {self.board[r][c] for r, c in line}
                        if len(pieces) == 1 and -1 not in pieces:
                            return pieces.pop()
        return None


def played(made: Game, seed: int, games: int) -> tuple[list[list[int]], list[list[object]]]:
    """Random games of one batch: the actions of each, and the positions it went through."""
    key, random = jax.random.key(0), np.random.default_rng(seed)
    step = jax.jit(jax.vmap(partial(made.step, key=key)))
    facts = jax.jit(jax.vmap(lambda p: (made.legal(p), made.player(p), made.terminated(p), made.rewards(p), made.observe(p))))
    positions = jax.vmap(made.init)(jax.random.split(key, games))
    actions: list[list[int]] = [[] for _ in range(games)]
    seen: list[list[object]] = [[] for _ in range(games)]
    alive = np.ones(games, bool)
    while alive.any():
        legal, player, terminated, rewards, observed = jax.device_get(facts(positions))
        for i in np.flatnonzero(alive):
            seen[i].append((legal[i], player[i], terminated[i], rewards[i], observed[i]))
        alive &= ~terminated
        chosen = np.array([random.choice(np.flatnonzero(row)) if row.any() else 0 for row in legal], np.int32)
        for i in np.flatnonzero(alive):
            actions[i].append(int(chosen[i]))
        positions = step(positions, chosen)
    return actions, seen


def test_the_rules_are_those_of_slow_python_over_random_games(id: str) -> None:
    made = game(id)
    ends = set()
    for actions, seen in zip(*played(made, 1, GAMES), strict=True):
        slow = SlowGame(id)
        assert len(seen) == len(actions) + 1 <= made.max_moves + 1
        for i, (legal, player, terminated, rewards, observed) in enumerate(seen):
            winner = slow.winner()
            assert terminated == (winner is not None or not any(slow.legal())) == (i == len(actions))
            assert rewards.tolist() == ([0, 0] if winner is None else [1, -1] if winner == 0 else [-1, 1])
            mover = slow.moves % 2
            assert observed.tolist() == [[[piece == mover, piece == 1 - mover] for piece in row] for row in slow.board]
            if not terminated:
                assert legal.tolist() == slow.legal() and player == mover
                slow.step(actions[i])
        ends.add(slow.winner())
    assert ends >= {0, 1}


def test_a_turned_game_is_the_same_game(id: str) -> None:
    made = game(id)
    key = jax.random.key(0)
    step, observe, legal = jax.jit(made.step), jax.jit(made.observe), jax.jit(made.legal)
    actions, _ = played(made, 2, 5)
    assert made.symmetries
    for symmetry in made.symmetries:
        # policy[actions] is the turned policy: its entry i is about what was action actions[i].
        turned_action = np.argsort(symmetry.actions)
        for moves in actions:
            plain = turned = made.init(key)
            for move in moves:
                np.testing.assert_array_equal(np.asarray(legal(plain))[symmetry.actions], legal(turned))
                plain, turned = step(plain, jnp.int32(move), key), step(turned, jnp.int32(turned_action[move]), key)
                np.testing.assert_array_equal(symmetry.observation(observe(plain)), observe(turned))
            np.testing.assert_array_equal(made.rewards(plain), made.rewards(turned))
    images = {symmetry.observation(observe(step(made.init(key), jnp.int32(1), key))).tobytes() for symmetry in made.symmetries}
    assert len(images) == (1 if id == "connect_four" else 4)


def test_names_go_there_and_back_and_the_board_is_what_was_played(id: str) -> None:
    made = game(id)
    key = jax.random.key(0)
    step = jax.jit(made.step)
    actions, _ = played(made, 3, 3)
    for moves in actions:
        position = made.init(key)
        slow = SlowGame(id)
        for move in moves:
            for action in np.flatnonzero(np.asarray(made.legal(position))):
                assert named_action(made, position, made.action_name(position, int(action))) == action
                assert named_action(made, position, made.action_name(position, int(action)).upper()) == action
            assert named_action(made, position, "z9") is None
            board = made.board(position)
            assert board.rows == tuple(tuple({-1: "", 0: "X", 1: "O"}[piece] for piece in row) for row in slow.board)
            assert set(board.clicks.values()) == set(np.flatnonzero(slow.legal()).tolist())
            position = step(position, jnp.int32(move), key)
            slow.step(move)
        assert made.board(position).clicks == {}


def test_a_wrong_name_gets_the_nearest(id: str) -> None:
    with pytest.raises(UserError, match=f"unknown game '{id[:-1]}'; did you mean '{id}'"):
        game(id[:-1])
    with pytest.raises(UserError, match=r"there is no file nowhere\.py"):
        game("nowhere.py:GAME")
    module, attribute = OWN_GAMES[id].split(":")
    assert game(f"{module}:{attribute}") is game(id)
    with pytest.raises(UserError, match=f"there is no such game; did you mean '{attribute}'"):
        game(f"{module}:{attribute[:-1]}")
    with pytest.raises(UserError, match=r"must be a thorndike\.games\.game\.Game"):
        game("math:pi")
