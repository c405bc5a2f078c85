"""Games in files: SGF and PGN there and back, records of GNU Go and python-chess, and files that are none."""

import io
import subprocess

import chess
import chess.pgn
import jax
import numpy as np
import pytest

from games.rules import Compiled, SlowGo
from thorndike.errors import UserError
from thorndike.games.engine_process import EngineProcess
from thorndike.games.engines import ENGINES, program_of
from thorndike.games.game_record import GameRecord, record_actions, result_of
from thorndike.games.gtp import told
from thorndike.games.pgn import read_pgn, write_pgn
from thorndike.games.registry import game
from thorndike.games.sgf import read_sgf, write_sgf

SGF_GAMES = ("connect_four", "othello", "hex", "go_9x9")


def random_record(id, seed):
    rules, random = Compiled(game(id)), np.random.default_rng(seed)
    position, moves = rules.init(jax.random.key(0)), []
    while True:
        legal, player, over, rewards = rules.facts(position)
        if over:
            return GameRecord(id, ("a ] \\ b", "white"), tuple(moves), tuple(map(float, rewards)))
        action = int(random.choice(legal))
        moves.append((player, rules.game.action_name(position, action)))
        position = rules.play(position, action)


@pytest.mark.parametrize("id", SGF_GAMES)
def test_sgf_goes_there_and_back(id, quick_compile):
    record = random_record(id, 1)
    assert read_sgf(write_sgf(record), "x.sgf") == record
    actions = record_actions(game(id), record)
    assert len(actions) == len(record.moves)
    assert result_of(game(id), actions) == record.result
    assert result_of(game(id), actions[:-1]) is None


def test_points_of_go_and_othello_are_those_of_the_format():
    record = GameRecord("go_9x9", ("b", "w"), ((0, "D4"), (1, "J9"), (0, "A1"), (1, "pass")))
    assert ";B[df];W[ia];B[ai];W[]" in write_sgf(record)
    othello = GameRecord("othello", ("b", "w"), ((0, "d3"), (1, "c5")))
    assert ";B[dc];W[ce]" in write_sgf(othello)
    assert "GM[11]" in write_sgf(GameRecord("hex", ("b", "w"), ((0, "a1"), (1, "swap"))))
    assert ";W[swap-pieces]" in write_sgf(GameRecord("hex", ("b", "w"), ((0, "a1"), (1, "swap"))))


def test_the_main_line_of_a_tree_is_read():
    text = "junk (;GM[1]SZ[9]PB[x\\]y]C[a (comment; with\n[marks\\] (1)];B[ee](;W[cc];B[tt])(;W[dd]))"
    record = read_sgf(text, "x.sgf")
    assert record.players == ("x]y", "white")
    assert record.moves == ((0, "E5"), (1, "C7"), (0, "pass"))
    assert read_sgf("(;FF[3]GaMe[2];B[dc])", "x").game == "othello"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "x.sgf is no SGF record: it has no game tree"),
        ("(", "it is not closed"),
        ("(;GM[1]SZ[9];B[ee]", "it is not closed"),
        ("()", "it has no node"),
        ("(;GM[1]SZ[9];B[ee", "unreadable at character"),
        ("(;GM[1]SZ[13];B[ee])", r"is a game \(GM\[1\], size 13\) that is not read"),
        ("(;GM[3];B[e2e4])", "that is not read; known: go_9x9"),
        ("(;GM[1]SZ[9]HA[2]AB[cc][gg];W[ee])", "handicap"),
        ("(;GM[1]SZ[9];B[zz])", "node 2: 'zz' is no point of the board"),
        ("(" * 1_000_001, "it is too long"),
    ],
)
def test_what_is_no_record_is_told(text, words):
    with pytest.raises(UserError, match=words):
        read_sgf(text, "x.sgf")


def test_an_illegal_record_is_told_with_the_move():
    with pytest.raises(UserError, match="move 2 of the record, d3, is not legal there"):
        record_actions(game("othello"), GameRecord("othello", ("b", "w"), ((0, "d3"), (1, "d3"))))
    with pytest.raises(UserError, match="move 2 of the record, e, is not legal there"):
        record_actions(game("connect_four"), GameRecord("connect_four", ("b", "w"), ((0, "d"), (0, "e"))))
    over = tuple((i % 2, name) for i, name in enumerate("ababababb"))
    with pytest.raises(UserError, match="comes after the end"):
        record_actions(game("connect_four"), GameRecord("connect_four", ("b", "w"), over))
    with pytest.raises(UserError, match="games of chess are not written as SGF"):
        write_sgf(GameRecord("chess", ("b", "w"), ()))


def test_passes_that_a_file_leaves_out_are_put_in(quick_compile):
    for seed in range(2, 40):
        record = random_record("othello", seed)
        without = record._replace(moves=tuple(move for move in record.moves if move[1] != "pass"))
        if len(record.moves) - len(without.moves) > 0 and record.moves[-1][1] != "pass":
            break
    assert record_actions(game("othello"), without) == record_actions(game("othello"), record)


def random_chess(seed, plies):
    board, random = chess.Board(), np.random.default_rng(seed)
    while not board.is_game_over() and board.ply() < plies:
        moves = list(board.legal_moves)
        board.push(moves[random.integers(len(moves))])
    return board


@pytest.mark.parametrize("seed", range(5))
def test_pgn_goes_there_and_back(seed):
    board = random_chess(seed, 150)
    moves = tuple((ply % 2, move.uci()) for ply, move in enumerate(board.move_stack))
    record = GameRecord("chess", ("Ada", "Bob"), moves, (1.0, -1.0))
    text = write_pgn(record)
    assert read_pgn(text, "x.pgn") == record
    game = chess.pgn.read_game(io.StringIO(text))
    assert game.end().board().fen() == board.fen()
    assert game.headers["Result"] == "1-0"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it holds no game"),
        ("1. e4 e4 *", "is no sound PGN record: illegal san: 'e4'"),
        ('[FEN "8/8/8/8/8/8/8/K1k5 w - - 0 1"]\n[SetUp "1"]\n\n*', "only chess from its usual beginning"),
        ("hello there", "holds no game"),
    ],
)
def test_what_is_no_pgn_is_told(text, words):
    with pytest.raises(UserError, match=words):
        read_pgn(text, "x.pgn")


def gnugo():
    try:
        return [program_of(ENGINES["gnugo"])]
    except UserError:
        return []


RULES = ("--boardsize", "9", "--chinese-rules", "--positional-superko")


def self_play(program, seed):
    """GNU Go against itself until nothing dead is left: the moves, and the score by its count."""
    process = EngineProcess((program, "--mode", "gtp", "--level", "1", "--seed", str(seed), *RULES))
    told(process, "komi 7.5")
    moves = []
    while moves[-2:] != ["PASS", "PASS"]:
        moves.append(told(process, f"kgs-genmove_cleanup {('black', 'white')[len(moves) % 2]}", 60))
    score = told(process, "final_score", 60)
    process.close()
    return moves, score


@pytest.mark.parametrize("program", gnugo())
def test_a_game_that_gnu_go_saved_replays_with_its_score(program, tmp_path, quick_compile):
    for seed in range(20):
        moves, score = self_play(program, seed)
        if "PASS" not in moves[:-2]:
            break
    # It saves games in its own dialogue only, and only before they end: all moves but the passes are repeated there.
    orders = ["komi 7.5", *(f"force {move}" for move in moves[:-2]), "save game.sgf", "quit"]
    words = [program, "--mode", "ascii", *RULES]
    subprocess.run(words, input="\n".join(orders) + "\n", cwd=tmp_path, text=True, capture_output=True, check=True, timeout=60)
    record = read_sgf((tmp_path / "game.sgf").read_text(), "game.sgf")
    assert [name for _, name in record.moves] == moves[:-2]
    record = record._replace(moves=(*record.moves, *((i % 2, "pass") for i in (len(moves), len(moves) + 1))))
    made = game("go_9x9")
    assert result_of(made, record_actions(made, record)) == ((1.0, -1.0) if score.startswith("B") else (-1.0, 1.0))
    slow = SlowGo(9)
    for _, name in record.moves:
        slow.play(name)
    assert slow.score() == (1 if score.startswith("B") else -1) * float(score[2:])
    assert len(record.moves) > 20
