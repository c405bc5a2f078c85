"""What a player of Go and of chess sees, square by square."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from games.rules import KEY, Compiled, SlowGo
from thorndike.games.game import Game, Position
from thorndike.games.registry import game
from thorndike.networks.board import board_network


def beginnings(made: Game, seed: int, most: int) -> list[tuple[Position, int | None, Compiled]]:
    """Positions of a random game, and the action that each was reached by."""
    compiled, random = Compiled(made), np.random.default_rng(seed)
    position, found = compiled.init(KEY), []
    last = None
    while len(found) < most and not compiled.facts(position)[2]:
        found.append((position, last, compiled))
        last = int(random.choice(compiled.facts(position)[0]))
        position = compiled.play(position, last)
    return found


def test_go_shows_groups_short_of_liberties_and_what_was_played_last(quick_compile):
    made, slow = game("go_9x9"), SlowGo(9)
    observe, names, ones, few = jax.jit(made.observe), [], 0, 0
    for position, action, compiled in beginnings(made, 2, 120):
        if action is not None:
            names.append(made.action_name(position, action))
            slow.play(names[-1])
        seen, other = np.asarray(observe(position)), "O" if slow.mover == "X" else "X"
        legal = set(compiled.facts(position)[0].tolist())
        for (row, column), stone in slow.board.items():
            stones, border = slow.group((row, column))
            liberties = {at for at in border if not slow.board[at]}
            touched = sum(not slow.board[at] for of in stones for at in slow.beside(of))
            is_one, is_few = bool(stone) and len(liberties) == 1, bool(stone) and len(liberties) > 1 and touched <= 3
            ones, few = ones + is_one, few + is_few
            at = slow.name((row, column))
            # A stone is on the board still unless it was taken at once.
            last, before = (len(names) > k and names[-1 - k] == at and bool(stone) for k in (0, 1))
            expected = [stone == slow.mover, stone == other]
            expected += [
                is_one and stone == slow.mover,
                is_one and stone == other,
                is_few and stone == slow.mover,
                is_few and stone == other,
            ]
            expected += [last, before and stone == slow.mover, 9 * row + column in legal, slow.mover == "O", slow.passes > 0, True]
            assert seen[row, column].tolist() == [float(value) for value in expected], (names, at)
    assert ones > 20 and few > 100


@pytest.mark.slow
@pytest.mark.parametrize("id", ["gardner_chess", "chess"])
def test_chess_shows_pieces_where_the_moves_of_their_squares_are_numbered(id, quick_compile):
    made = game(id)
    observe, size = jax.jit(made.observe), {"gardner_chess": 5, "chess": 8}[id]
    for position, _, compiled in beginnings(made, 3, 60):
        seen, board, black = np.asarray(observe(position)), made.board(position), compiled.facts(position)[1] == 1
        for file in range(size):
            for rank in range(size):
                letter = board.rows[rank if black else size - 1 - rank][file]
                mine = letter.upper() if letter and letter.isupper() != black else ""
                other = letter.upper() if letter and not mine else ""
                assert seen[file, rank, :12].tolist() == [float(piece == mine) for piece in "PNBRQK"] + [
                    float(piece == other) for piece in "PNBRQK"
                ]
        movers = set(np.flatnonzero(seen[..., :6].sum(axis=-1).reshape(-1)).tolist())
        assert {action // (made.num_actions // size**2) for action in compiled.facts(position)[0].tolist()} <= movers
        assert seen[..., 12].min() == 1


def test_squares_say_what_their_moves_are_worth_by_the_same_weights():
    network = board_network(2 * 20 + 1, "squares", 8, 0)
    board = jax.random.normal(KEY, (1, 4, 5, 3))
    params = network.init(KEY, board)
    logits, _ = network.apply(params, board)
    moved, _ = network.apply(params, jnp.roll(board, 1, axis=2))
    by_square, by_moved = (x[0, :-1].reshape(4, 5, 2) for x in (logits, moved))
    # Away from the edge a shifted board has the shifted moves.
    np.testing.assert_allclose(by_moved[:, 2:-1], by_square[:, 1:-2], rtol=1e-5, atol=1e-7)
    assert float(jnp.abs(by_square).max()) > 0
