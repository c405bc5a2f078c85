"""Random positions of Connect Four by stratum, labelled by a perfect solver. It runs in .venv-opponents, in a process of its own.

Pascal Pons' strata: by moves played (begin: up to 14, middle: up to 28, end) and by moves left under perfect play (easy: under 14, medium:
under 28, hard). A line a position: stratum, the columns played, and the solver's score of every column (empty where it is full): above 0
wins, 0 draws, below loses, the larger the sooner or the later.
"""

import random
import sys

from bitbully import BitBully, Board

STRATA = {
    "begin_easy": (0, 14, 0, 13),
    "begin_medium": (0, 14, 14, 27),
    "begin_hard": (0, 14, 28, 42),
    "middle_easy": (15, 28, 0, 13),
    "middle_medium": (15, 28, 14, 27),
    "end_easy": (29, 41, 0, 13),
}
"""Least and most moves played, least and most moves left."""


def played(generator: random.Random, plies: int) -> list[int] | None:
    """That many random moves of a game that is not over after them and cannot be won by the next one, or None if it is or can."""
    board = Board()
    moves: list[int] = []
    while len(moves) < plies and not board.is_game_over():
        moves.append(generator.choice(board.legal_moves()))
        board.play(moves[-1])
    return None if board.is_game_over() or board.can_win_next() else moves


def moves_left(plies: int, score: int) -> int:
    """Until the end under perfect play: the winner's last piece is number 22 - |score| of its colour."""
    if score == 0:
        return 42 - plies
    winner = plies % 2 if score > 0 else 1 - plies % 2
    return 2 * (22 - abs(score)) - (1 - winner) - plies


def main(count: int, seed: int) -> None:
    """Print ``count`` different positions of each stratum, the same for the same seed."""
    solver = BitBully(opening_book="12-ply-dist")
    for number, (name, (fewest, most, least, longest)) in enumerate(STRATA.items()):
        generator = random.Random(f"{seed}/{number}")
        found: set[str] = set()
        while len(found) < count:
            moves = played(generator, generator.randint(fewest, most))
            text = "" if moves is None else "".join(map(str, moves))
            if moves is None or text in found:
                continue
            scores = solver.score_all_moves(Board(moves))
            if least <= moves_left(len(moves), max(scores.values())) <= longest:
                found.add(text)
                print(name, text or "-", ",".join(str(scores.get(column, "")) for column in range(7)), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
