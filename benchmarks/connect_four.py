"""How well a trained policy plays Connect Four: errors against a perfect solver, and a match against OpenSpiel's tree search.

python benchmarks/connect_four.py RUN          both, into benchmarks/results/connect_four.json (a row a run; other rows stay)
python benchmarks/connect_four.py --positions  make benchmarks/data/connect_four.txt again: 200 positions of each of six strata
python benchmarks/connect_four.py --depth 5    the errors of a search of this depth that knows nothing but wins and losses, to compare with

The opponents run in .venv-opponents (`make opponents`), in processes of their own. An error is a move after which the game is worth less,
lost instead of drawn or drawn instead of won, than after the best one.
"""

import argparse
import json
import math
import random
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import thorndike as td
from machine import keep_row, origin
from thorndike.api.building import build_algorithm
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import observed_position

ROOT = Path(__file__).parents[1]
OPPONENTS = ROOT / ".venv-opponents" / "bin" / "python"
DATA = ROOT / "benchmarks" / "data" / "connect_four.txt"
RESULT = ROOT / "benchmarks" / "results" / "connect_four.json"
EACH, POSITIONS_SEED, MATCH_SEED = 200, 2026, 7
KEY = jax.random.key(0)
Choose = Callable[[Sequence[str]], list[int]]
"""Games, as the columns played -> a move of each."""


class Labelled(NamedTuple):
    """A position, and what the solver says of each move: 1 wins, 0 draws, -1 loses, None where the column is full."""

    stratum: str
    moves: str
    signs: tuple[int | None, ...]


def labelled() -> list[Labelled]:
    rows = [line.split() for line in DATA.read_text(encoding="utf-8").splitlines()]
    return [
        Labelled(name, moves.strip("-"), tuple(None if text == "" else int(np.sign(int(text))) for text in scores.split(",")))
        for name, moves, scores in rows
    ]


def errors(choose: Choose) -> dict[str, float]:
    """Per cent of positions of each stratum in which the move is an error."""
    rows = labelled()
    wrong: dict[str, list[bool]] = {}
    for row, move in zip(rows, choose([row.moves for row in rows]), strict=True):
        sign = row.signs[move]
        if sign is None:
            raise ValueError(f"column {move} is full after {row.moves}")
        wrong.setdefault(row.stratum, []).append(sign < max(each for each in row.signs if each is not None))
    return {name: round(100 * float(np.mean(values)), 1) for name, values in wrong.items()}


def agent(run: Path, simulations: int, size: int) -> Choose:
    """The best seed of a run, with that many simulations a move, ``size`` positions at a time."""
    policy = td.load(run).policy
    facts = td.load(run).facts
    algorithm = build_algorithm("alphazero", {**facts["config"], "eval_simulations": simulations}, policy.spec, None)
    actor = jax.tree.map(lambda leaf: leaf[policy.best], policy.actors)
    noise = policy.noise(KEY, size)
    decide = jax.jit(lambda positions: algorithm.greedy(actor, algorithm.memory(size), observed(positions), noise)[1])
    observed = jax.vmap(lambda position: observed_position(CONNECT_FOUR, position))

    def choose(games: Sequence[str]) -> list[int]:
        filled = [*games, *[""] * (-len(games) % size)]
        parts = [np.asarray(decide(positions_of(filled[i : i + size]))) for i in range(0, len(filled), size)]
        return [int(move) for move in np.concatenate(parts)[: len(games)]]

    return choose


@jax.jit
def _played(columns: jax.Array) -> jax.Array:
    def move(position, column):
        after = CONNECT_FOUR.step(position, jnp.maximum(column, 0), KEY)
        return jax.tree.map(lambda new, old: jnp.where(column >= 0, new, old), after, position), None

    return jax.vmap(lambda row: jax.lax.scan(move, CONNECT_FOUR.init(KEY), row)[0])(columns)


def positions_of(games: Sequence[str]) -> jax.Array:
    """The positions after these moves, ``[B]``."""
    columns = np.full((len(games), CONNECT_FOUR.max_moves), -1, np.int32)
    for row, moves in zip(columns, games, strict=True):
        row[: len(moves)] = [int(column) for column in moves]
    return _played(columns)


def minimax(depth: int) -> Choose:
    """Plain search of all lines of that length: wins and losses in sight, else 0; the first of equal moves, from the middle."""

    def best(moves: str) -> int:
        board = [[] for _ in range(7)]
        for number, column in enumerate(moves):
            board[int(column)].append(number % 2)
        scores = {column: -_worth(board, column, len(moves) % 2, depth - 1) for column in (3, 2, 4, 1, 5, 0, 6) if len(board[column]) < 6}
        return max(scores, key=lambda column: scores[column])

    return lambda games: [best(moves) for moves in games]


def _worth(board: list[list[int]], column: int, player: int, depth: int) -> int:
    """After ``player`` moves in ``column``: for the other one."""
    board[column].append(player)
    if _wins(board, column, player):
        found = -1
    elif depth == 0 or all(len(each) == 6 for each in board):
        found = 0
    else:
        found = -1
        for reply in (3, 2, 4, 1, 5, 0, 6):
            if len(board[reply]) < 6:
                found = max(found, -_worth(board, reply, 1 - player, depth - 1))
                if found == 1:
                    break
    board[column].pop()
    return found


def _wins(board: list[list[int]], column: int, player: int) -> bool:
    row = len(board[column]) - 1
    for right, up in ((1, 0), (0, 1), (1, 1), (1, -1)):
        length = 1
        for way in (1, -1):
            c, r = column + way * right, row + way * up
            while 0 <= c < 7 and 0 <= r < len(board[c]) and board[c][r] == player:
                length, c, r = length + 1, c + way * right, r + way * up
        if length >= 4:
            return True
    return False


class Match(NamedTuple):
    """Games won, drawn and lost."""

    wins: int
    draws: int
    losses: int

    def described(self) -> dict[str, object]:
        """With the score, draws as half, and its Wilson interval."""
        games = sum(self)
        score = (self.wins + self.draws / 2) / games
        middle, half = (score + 1.92 / games) / (1 + 3.84 / games), 1.96 * math.sqrt(score * (1 - score) / games + 0.96 / games**2)
        half /= 1 + 3.84 / games
        return {**self._asdict(), "score": round(score, 4), "wilson95": [round(middle - half, 4), round(middle + half, 4)]}


def match(first: Choose, second: Choose, games: int) -> Match:
    """Both sides of ``games / 2`` different openings of 0 to 4 random moves, all games side by side."""
    generator, openings = random.Random(MATCH_SEED), []
    while len(openings) < games // 2:
        text = "".join(str(generator.randrange(7)) for _ in range(generator.randint(0, 4)))
        if text not in openings:
            openings.append(text)
    texts = [text for text in openings for _ in range(2)]
    over = jax.jit(jax.vmap(lambda position: (CONNECT_FOUR.terminated(position), CONNECT_FOUR.rewards(position)[0])))
    while True:
        ended, reward = (np.asarray(x) for x in over(positions_of(texts)))
        if ended.all():
            break
        for choose, side in ((first, 0), (second, 1)):
            # Game 2k is played by the first player as whoever moves first, game 2k + 1 as the other.
            due = [i for i, text in enumerate(texts) if not ended[i] and len(text) % 2 == (side + i) % 2]
            if due:
                for i, move in zip(due, choose([texts[i] for i in due]), strict=True):
                    texts[i] += str(move)
            ended, reward = (np.asarray(x) for x in over(positions_of(texts)))
    own = [float(reward[i]) if i % 2 == 0 else -float(reward[i]) for i in range(games)]
    return Match(own.count(1.0), own.count(0.0), own.count(-1.0))


class OpenSpiel:
    """OpenSpiel's player, as a process."""

    def __init__(self, python: Path, rollouts: int) -> None:
        self._process = subprocess.Popen(
            [python, ROOT / "benchmarks" / "opponents" / "open_spiel_mcts.py", str(rollouts), str(MATCH_SEED)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, games: Sequence[str]) -> list[int]:
        """Its move in each game."""
        moves = []
        for text in games:
            self._process.stdin.write(text + "\n")
            self._process.stdin.flush()
            moves.append(int(self._process.stdout.readline()))
        return moves

    def close(self) -> None:
        """End the process."""
        self._process.stdin.close()
        self._process.wait(timeout=60)


def measure(run: Path, python: Path, simulations: int, games: int, rollouts: int) -> dict[str, object]:
    record = json.loads((run / "run.json").read_text(encoding="utf-8")) if (run / "run.json").exists() else {}
    row: dict[str, object] = {name: record.get(name) for name in ("steps_done", "cpu_s", "wall_s", "compile_s")}
    row["network_errors"] = errors(agent(run, 0, EACH))
    print("network alone:", row["network_errors"], flush=True)
    began = time.process_time()
    row[f"errors_{simulations}"] = errors(agent(run, simulations, EACH))
    print(f"{simulations} simulations:", row[f"errors_{simulations}"], f"({time.process_time() - began:.0f} CPU-s)", flush=True)
    if games:
        other = OpenSpiel(python, rollouts)
        row[f"open_spiel_{rollouts}"] = match(agent(run, simulations, games), other, games).described()
        other.close()
        print(f"against OpenSpiel's MCTS with {rollouts} rollouts:", row[f"open_spiel_{rollouts}"], flush=True)
    return row


def make_positions(python: Path) -> None:
    program = ROOT / "benchmarks" / "opponents" / "solve_connect_four.py"
    made = subprocess.run([python, program, str(EACH), str(POSITIONS_SEED)], check=True, capture_output=True, text=True)
    DATA.write_text(made.stdout, encoding="utf-8")
    print(f"{DATA}: {len(made.stdout.splitlines())} positions")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path, help="a run, or a folder that holds an exported policy")
    parser.add_argument("--positions", action="store_true")
    parser.add_argument("--depth", type=int)
    parser.add_argument("--simulations", type=int, default=200)
    parser.add_argument("--games", type=int, default=100)
    parser.add_argument("--rollouts", type=int, default=1000)
    parser.add_argument("--name", help="what the row is called (default: the run's folder)")
    parser.add_argument("--opponents", type=Path, default=OPPONENTS, help="the opponents' Python (default: .venv-opponents)")
    options = parser.parse_args()
    if options.positions:
        make_positions(options.opponents)
    if options.depth is not None:
        found = {**origin(), "errors": errors(minimax(options.depth))}
        keep_row(RESULT, f"minimax, depth {options.depth}", found)
        print(found)
    if options.run is not None:
        row = measure(options.run, options.opponents, options.simulations, options.games, options.rollouts)
        keep_row(RESULT, options.name or options.run.name, {**origin(), **row})


if __name__ == "__main__":
    main()
