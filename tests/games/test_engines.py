"""Programs as players: real ones where they are installed, and one that dies, hangs, babbles, cheats and will not leave."""

import os
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from games.rules import Compiled
from thorndike.errors import UserError
from thorndike.games.engine_player import engine_player
from thorndike.games.engine_process import EngineFailure, EngineProcess
from thorndike.games.engines import ENGINES, check_engine, engine, program_of
from thorndike.games.game import Stopped, Turn, named_action
from thorndike.games.gtp import gtp_start
from thorndike.games.registry import game
from thorndike.games.uci import told_probability, uci_start

FAKE = str(Path(__file__).with_name("fake_engine.py"))
MOVES = "b2 a1 c1 a3 a2 c3 b1 c2 b3"
"""Of tic-tac-toe, by both players."""


@pytest.fixture(scope="module")
def board():
    return Compiled(game("tic_tac_toe"))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "moves").write_text(MOVES)
    return tmp_path


def player_of(folder, fault, protocol="gtp", limit_s=20.0):
    command = (sys.executable, FAKE, protocol, fault, str(folder))
    start = gtp_start(command, 3, None, limit_s) if protocol == "gtp" else uci_start(command, {"Level": "3"}, {"nodes": 5}, limit_s)
    return engine_player(f"fake-{fault}", start)


def played(board, player, plies=5):
    """The player against itself; the actions, and what it said last."""
    position, moves = board.init(jax.random.key(0)), []
    for _ in range(plies):
        choice = player.choose(Turn(board.game, position, tuple(moves)))
        if choice.resigns:
            return moves, choice
        moves.append(choice.action)
        position = board.play(position, choice.action)
    return moves, choice


def started(folder):
    return [int(pid) for pid in (folder / "started").read_text().split()]


def assert_gone(folder):
    """Neither running nor dead: no child of ours has these numbers any more."""
    for pid in started(folder):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.parametrize("protocol", ["gtp", "uci"])
def test_a_sound_engine_plays_its_moves_and_leaves(board, folder, protocol):
    player = player_of(folder, "none", protocol)
    moves, choice = played(board, player)
    names = ["b2", "a1", "c1", "a3", "a2"]
    assert [board.game.action_name(None, move) for move in moves] == names
    assert choice.win_probability == (None if protocol == "gtp" else pytest.approx(0.640, abs=1e-3))
    assert len(started(folder)) == 1
    player.close()
    assert_gone(folder)
    heard = (folder / "heard").read_text()
    if protocol == "gtp":
        assert heard.count("clear_board") == 1
        assert heard.endswith("play white a3\ngenmove black\nundo\nquit\n")
    else:
        assert "setoption name Level value 3\nisready\n" in heard
        assert "position startpos moves b2 a1 c1 a3\ngo nodes 5\nquit" in heard


def test_it_follows_to_another_game_and_back(board, folder):
    player = player_of(folder, "none")
    played(board, player, 4)
    start = board.init(jax.random.key(0))
    other = board.play(start, 0)
    player.choose(Turn(board.game, other, (0,)))
    heard = (folder / "heard").read_text()
    assert heard.count("clear_board") == 2
    assert heard.endswith("play black a3\ngenmove white\nundo\n")
    player.close()


@pytest.mark.parametrize("protocol", ["gtp", "uci"])
def test_one_that_is_stopped_is_ended_and_started_again_when_it_is_asked(board, folder, protocol):
    player, asked = player_of(folder, "hangs", protocol), []
    start = board.init(jax.random.key(0))
    player.choose(Turn(board.game, start, ()))
    second = Turn(board.game, board.play(board.play(start, 4), 6), (4, 6), stopped=lambda: len(asked) > 1 or asked.append(1))
    with pytest.raises(Stopped):
        player.choose(second)
    assert_gone(folder)
    assert len(started(folder)) == 1, "it is not taken for a crash"
    assert board.game.action_name(None, player.choose(Turn(board.game, start, ())).action) == "b2"
    player.close()
    assert_gone(folder)


@pytest.mark.parametrize("protocol", ["gtp", "uci"])
def test_a_crash_is_mended_once_and_the_moves_are_told_again(board, folder, protocol):
    player = player_of(folder, "dies-once", protocol)
    moves, _ = played(board, player)
    assert [board.game.action_name(None, move) for move in moves] == ["b2", "a1", "c1", "a3", "a2"]
    assert len(started(folder)) == 2
    player.close()
    assert_gone(folder)


@pytest.mark.parametrize(
    ("fault", "limit_s", "words"),
    [
        ("dies", 20, r"fake-dies ended unexpectedly, and once more after a fresh start \(move 3\)"),
        ("hangs", 0.3, "fake-hangs did not answer in time, and once more"),
        ("refuses", 20, "fake-refuses refused 'boardsize 3': unknown command, and once more"),
        ("endless-line", 0.5, "fake-endless-line did not answer in time"),
    ],
)
def test_who_fails_twice_is_given_up(board, folder, fault, limit_s, words):
    player = player_of(folder, fault, limit_s=limit_s)
    began = time.monotonic()
    with pytest.raises(UserError, match=words):
        played(board, player)
    assert time.monotonic() - began < 15
    assert len(started(folder)) == 2
    assert_gone(folder)


@pytest.mark.parametrize("protocol", ["gtp", "uci"])
def test_an_illegal_move_forfeits_the_game(board, folder, protocol):
    player = player_of(folder, "illegal", protocol)
    moves, choice = played(board, player)
    assert moves == []
    assert choice.remark == "fake-illegal forfeits: 'z99' is no legal move here"
    player.close()


def test_an_engine_may_resign_and_may_babble(board, folder):
    player = player_of(folder, "resigns")
    assert played(board, player)[1].remark == "fake-resigns resigns"
    player.close()
    player = player_of(folder, "babbles")
    assert len(played(board, player)[0]) == 5
    player.close()
    assert_gone(folder)


def test_who_will_not_leave_is_ended_with_its_children(folder):
    process = EngineProcess((sys.executable, FAKE, "gtp", "stays", str(folder)))
    process.send("name")
    process.line(time.monotonic() + 20)
    began = time.monotonic()
    process.close()
    assert 0.9 < time.monotonic() - began < 5
    assert_gone(folder)
    with pytest.raises(EngineFailure, match="ended unexpectedly"):
        process.send("name")


def test_only_one_move_is_not_asked_for(board, folder):
    player = player_of(folder, "dies")
    position = board.init(jax.random.key(0))
    moves = [named_action(board.game, position, name) for name in ["b2", "a1", "c1", "a3", "a2", "c2", "b3", "b1"]]
    for move in moves:
        position = board.play(position, move)
    assert player.choose(Turn(board.game, position, tuple(moves))).action == named_action(board.game, position, "c3")
    assert not (folder / "started").exists()


def test_a_program_that_is_not_there_cannot_be_started():
    with pytest.raises(EngineFailure, match="cannot be started: No such file"):
        EngineProcess(("/no/such/engine",))


def test_short_names_are_checked_at_once(monkeypatch):
    with pytest.raises(UserError, match="gnugo: level is a whole number from 1 to 10, not '11'"):
        check_engine("gnugo:level=11", "go_9x9")
    with pytest.raises(UserError, match="gnugo has no setting 'levl'; did you mean 'level'"):
        check_engine("gnugo:levl=1", "go_9x9")
    with pytest.raises(UserError, match="rhino plays othello, not chess"):
        check_engine("rhino", "chess")
    with pytest.raises(UserError, match="gtp: must be followed by a command"):
        check_engine("gtp:", "go_9x9")
    with pytest.raises(UserError, match="there is no program 'no-such-program'"):
        check_engine("uci:no-such-program -x", "chess")
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setattr("thorndike.games.engines._BEYOND_PATH", "/nowhere")
    with pytest.raises(UserError, match="gtp-rhino is not installed; on Debian: apt install grhino"):
        check_engine("rhino", "othello")


def test_pachi_is_looked_for_on_the_path_and_told_how_much_to_think(board, folder, monkeypatch):
    """A program that notes its words and then plays as the others here do."""
    places = [folder / name for name in ("bin", "games")]
    for place in places:
        place.mkdir()
        (place / "pachi").write_text(f'#!/bin/sh\necho "$@" > {folder}/words\nexec {sys.executable} {FAKE} gtp none {folder}\n')
        (place / "pachi").chmod(0o755)
    monkeypatch.setattr("thorndike.games.engines._BEYOND_PATH", str(places[1]))
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(UserError, match=r"pachi is not installed; build it from https://github.com/pasky/pachi \(no package of Debian's\)"):
        engine("pachi", "go_9x9")
    monkeypatch.setenv("PATH", f"{places[1]}{os.pathsep}{places[0]}")
    assert program_of(ENGINES["pachi"]) == str(places[0] / "pachi")
    player = engine("pachi:simulations=300,seed=5", "go_9x9")
    # Its board is smaller, but the first two moves are on both.
    (folder / "moves").write_text("B2 C1")
    rules = game("go_9x9")
    assert rules.action_name(None, player.choose(Turn(rules, rules.init(jax.random.key(0)), ())).action) == "B2"
    player.close()
    assert (folder / "words").read_text() == "-d 0 -r chinese -t =300 -s 5 threads=1\n"
    heard = (folder / "heard").read_text()
    assert heard.startswith("boardsize 9\nclear_board\nkomi 7.5\n") and "kgs-genmove_cleanup black\n" in heard
    with pytest.raises(UserError, match="pachi: simulations is a whole number from 1"):
        engine("pachi:simulations=0", "go_9x9")


def test_probabilities_of_winning_are_read_from_thoughts():
    assert told_probability(["info", "depth", "3", "score", "cp", "0", "nodes", "5"], None) == 0.5
    assert told_probability(["info", "score", "mate", "-3"], 0.4) == 0.0
    assert told_probability(["info", "score", "mate", "1"], 0.4) == 1.0
    assert told_probability(["info", "score", "cp", "x"], 0.4) == 0.4
    assert told_probability(["info", "string", "score"], 0.4) == 0.4
    assert told_probability(["info", "depth", "3"], 0.4) == 0.4


def installed(names):
    """Those of ``engine, game`` whose program is here."""
    found = []
    for name, id in names:
        try:
            program_of(ENGINES[name.partition(":")[0]])
        except UserError:
            continue
        found.append((name, id))
    return found


@pytest.mark.parametrize(
    ("name", "id"), installed([("rhino:level=1", "othello"), ("gnugo:level=1", "go_9x9"), ("pachi:simulations=300", "go_9x9")])
)
def test_real_engines_beat_random_moves_as_either_side(name, id, quick_compile):
    rules, random = Compiled(game(id)), np.random.default_rng(1)
    player = engine(name, id)
    for side in (0, 1):
        position, moves = rules.init(jax.random.key(0)), []
        while True:
            legal, mover, over, rewards = rules.facts(position)
            if over:
                break
            if mover == side:
                choice = player.choose(Turn(rules.game, position, tuple(moves)))
                assert not choice.resigns, choice.remark
                action = choice.action
            else:
                action = int(random.choice(legal))
            moves.append(action)
            position = rules.play(position, action)
        assert rewards[side] == 1
    player.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "id"), installed([("stockfish:skill=0,nodes=200", "chess"), *(("fairy:nodes=200", id) for id in ENGINES["fairy"].games)])
)
def test_real_chess_engines_play_legal_games_against_random_moves(name, id, quick_compile):
    rules, random = Compiled(game(id)), np.random.default_rng(1)
    player = engine(name, id)
    position, moves = rules.init(jax.random.key(0)), []
    for ply in range(120):
        legal, mover, over, _ = rules.facts(position)
        if over:
            break
        choice = player.choose(Turn(rules.game, position, tuple(moves))) if mover == 0 else None
        assert choice is None or not choice.resigns, (ply, choice.remark)
        moves.append(int(random.choice(legal)) if choice is None else choice.action)
        position = rules.play(position, moves[-1])
    assert len(moves) > 5
    player.close()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "id"), installed([("fairy", id) for id in ENGINES["fairy"].games]))
def test_legal_moves_are_those_of_fairy_stockfish(name, id, quick_compile):
    rules, random = Compiled(game(id)), np.random.default_rng(2)
    protocol = "usi" if "shogi" in id else "uci"
    variant = {"gardner_chess": "gardner", "animal_shogi": "dobutsu"}.get(id, id)
    process = EngineProcess((program_of(ENGINES[name]),))
    process.send(protocol)
    process.send(f"setoption name UCI_Variant value {variant}")
    for _ in range(3):
        position, names = rules.init(jax.random.key(0)), []
        for _ in range(60):
            legal, _, over, _ = rules.facts(position)
            if over:
                break
            process.send("position startpos" + (" moves " if names else "") + " ".join(names))
            process.send("go perft 1")
            listed = []
            while not (line := process.line(time.monotonic() + 20)).startswith("Nodes searched"):
                listed += [line.split(":")[0]] if line.endswith(": 1") else []
            # A chick need not become a hen there.
            listed = [move for move in listed if id != "animal_shogi" or f"{move}+" not in listed]
            assert sorted(rules.game.action_name(position, move) for move in legal) == sorted(listed), names
            action = int(random.choice(legal))
            names.append(rules.game.action_name(position, action))
            position = rules.play(position, action)
        assert len(names) > 5
    process.close()
