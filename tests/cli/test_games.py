"""`arena` and `play` through the command line: results, files, a person's mistakes, and how they end."""

import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import thorndike as td
from made_up_runs import write_run
from thorndike.cli.arena import _elo
from thorndike.cli.choose_player import choose_player
from thorndike.cli.main import main
from thorndike.games.sgf import read_sgf
from thorndike.games.trained import trained_run

FAKE = Path(__file__).parents[1] / "games" / "fake_engine.py"
pytestmark = pytest.mark.usefixtures("quick_compile")


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def typed(monkeypatch, *lines):
    monkeypatch.setattr("sys.stdin", io.StringIO("".join(f"{line}\n" for line in lines)))


def test_an_arena_tells_results_and_goes_on_with_what_is_there(capsys):
    words = ["arena", "tic_tac_toe", "random", "mcts:simulations=8", "random", "--games", "4", "--save", "games", "--json"]
    assert main(words) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["player"] for row in told["players"]] == ["random", "mcts:simulations=8", "random #2"]
    assert sum(row["elo"] for row in told["players"]) == pytest.approx(0, abs=1e-6)
    assert [row["games"] for row in told["players"]] == [8, 8, 8]
    assert [match["wins"] + match["draws"] + match["losses"] for match in told["matches"]] == [4, 4, 4]
    assert sorted(path.suffix for path in Path("games").iterdir()) == [".jsonl"] * 3
    kept = {path: path.read_bytes() for path in Path("games").iterdir()}
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == told
    assert {path: path.read_bytes() for path in Path("games").iterdir()} == kept
    assert main(["arena", "tic_tac_toe", "random", "mcts:simulations=8", "--games", "2", "--seed", "1", "--save", "games"]) == 2
    assert "is of another match: its seed is 0, not 1" in capsys.readouterr().err


def test_an_arena_for_people_has_a_row_for_each_player_and_match(capsys):
    assert main(["arena", "connect_four", "random", "random", "--games", "2", "--save", "games"]) == 0
    out = capsys.readouterr().out
    assert "random #2" in out
    assert "won-drawn-lost" in out
    record = read_sgf(Path("games/random-random__2.sgf").read_text(), "x")
    assert record.game == "connect_four"
    assert record.players == ("random", "random #2")


def test_differences_are_whole_numbers_of_which_none_is_minus_zero():
    assert [_elo(value) for value in (-0.3, 0.4, -12.6, math.inf, -math.inf, math.nan)] == ["+0", "+0", "-13", "+inf", "-inf", "?"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["arena", "tic_tac_toe", "random"], "arena needs at least two players"),
        (["arena", "tic_tac", "random", "random"], "unknown game 'tic_tac'; did you mean 'tic_tac_toe'?"),
        (["arena", "2048", "random", "random"], "2048 is played by one"),
        (["arena", "backgammon", "random", "mcts"], "mcts plays games of two players without dice"),
        (["arena", "chess", "random", "gnugo"], "gnugo plays go_9x9 and go_19x19, not chess"),
        (["arena", "chess", "randon", "random"], "there is no player 'randon'; did you mean 'random'?"),
        (["arena", "chess", "random", "mcts:simulations=0"], "simulations is a whole number from 1 to 1000000, not '0'"),
        (["arena", "chess", "random", "random", "--games", "0"], "expected a whole number of at least 1"),
        (["play", "2048", "--second"], "2048 is played by one: leave --against and --second out"),
        (["play", "hexx"], "did you mean 'hex'?"),
        (["play", "go_9x9", "--against", "stockfish"], "stockfish plays chess, not go_9x9"),
        (["play", "tic_tac_toe", "--against", "uci:no-such-program"], "there is no program 'no-such-program'"),
        (["play"], "GAME"),
    ],
)
def test_a_mistake_is_one_line(words, told, capsys):
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err
    assert err.count("\n") == 1


def test_a_game_is_played_to_its_end(monkeypatch, capsys):
    typed(monkeypatch, "a1", "b1", "c1", "a2", "b2", "c2", "a3", "b3", "c3")
    assert main(["play", "tic_tac_toe", "--against", "random", "--seed", "1"]) == 0
    out = capsys.readouterr().out
    assert "random plays" in out
    assert out.splitlines()[-1].startswith(("you won after", "you lost after", "a draw after"))


def test_commands_and_mistakes_while_playing(monkeypatch, capsys):
    typed(monkeypatch, "moves", "b2", "b2", "undo", "undo", "B2", "hint", "hnt", "", "board", "save x.json", "save x.json", "save", "quit")
    assert main(["play", "tic_tac_toe", "--against", "mcts:simulations=16", "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert told["over"] is False
    assert told["score"] is None
    assert told["moves"][0] == "b2"
    assert len(told["moves"]) == 2
    lines = [line.split("> ")[-1] for line in err.splitlines()]
    assert "a3 b3 c3 a2 b2 c2 a1 b1 c1" in lines
    assert any(line.startswith("b2 is no legal move; ") for line in lines)
    assert "there is no move of yours to take back" in lines
    assert any(line.startswith("mcts:simulations=16 would play") and "expects" in line for line in lines)
    assert "hnt is no legal move; did you mean hint?" in lines
    assert "x.json is there already: give another name" in lines
    assert "saved: tic_tac_toe-1.json" in lines
    assert json.loads(Path("x.json").read_text())["moves"] == told["moves"]


def test_the_other_one_may_begin_and_the_end_of_the_input_is_an_end(monkeypatch, capsys):
    typed(monkeypatch)
    assert main(["play", "connect_four", "--against", "random", "--second"]) == 0
    out = capsys.readouterr().out
    assert out.count("random plays") == 1
    assert out.splitlines()[-1] == "left after 1 moves"


@pytest.mark.slow
def test_against_a_game_of_ones_own_with_dice_random_moves_are_the_default(place, monkeypatch, capsys):
    place.joinpath("mine.py").write_text(
        "from thorndike.games.tic_tac_toe import TIC_TAC_TOE\nDICE = TIC_TAC_TOE._replace(id='mine', has_chance=True)\n"
    )
    typed(monkeypatch, "quit")
    assert main(["play", "mine.py:DICE"]) == 0
    assert "mine against random" in capsys.readouterr().out


def test_a_game_for_one_counts_its_points(monkeypatch, capsys):
    typed(monkeypatch, *["left", "up", "right", "down"] * 20, "undo", "hint")
    assert main(["play", "2048", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["against"] is None
    assert "nobody here can give advice in this game" in err


def engine(place, fault):
    (place / "moves").write_text("b2 a1 c1 a3 a2 c3 b1 c2 b3")
    return f"uci:{sys.executable} {FAKE} uci {fault} {place}"


def test_an_engine_by_its_command_plays_and_is_ended(place, monkeypatch, capsys):
    typed(monkeypatch, "quit")
    assert main(["play", "tic_tac_toe", "--against", engine(place, "none"), "--second"]) == 0
    assert "plays b2 (expects 64%)" in capsys.readouterr().out
    for pid in (place / "started").read_text().split():
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


def test_a_cheating_engine_loses_its_games_and_is_named(place, capsys):
    assert main(["arena", "tic_tac_toe", "random", engine(place, "illegal"), "--games", "2", "--json"]) == 0
    match = json.loads(capsys.readouterr().out)["matches"][0]
    assert (match["wins"], match["losses"]) == (2, 0)
    assert "'z99' is no legal move here" in match["remarks"][0]


def test_a_broken_engine_is_one_line(place, capsys):
    assert main(["arena", "tic_tac_toe", "random", engine(place, "dies"), "--games", "4"]) == 2
    err = capsys.readouterr().err
    assert "ended unexpectedly, and once more after a fresh start" in err
    assert err.count("\n") == 1


def test_ctrl_c_ends_the_game_and_the_engine(place):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2] / "src")}
    words = ["play", "tic_tac_toe", "--against", engine(place, "none"), "--second"]
    running = subprocess.Popen(
        [sys.executable, "-m", "thorndike", *words],
        cwd=place,
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    until = time.monotonic() + 60
    while "go movetime" not in ((place / "heard").read_text() if (place / "heard").exists() else "") and time.monotonic() < until:
        time.sleep(0.05)
    time.sleep(0.5)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=30)
    assert running.returncode == 130
    assert err == "thorndike: interrupted\n"
    assert "plays b2" in out
    for pid in (place / "started").read_text().split():
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)


def test_the_public_api_plays(place):
    match = td.play_match("tic_tac_toe", "random", td.player("random", "tic_tac_toe", seed=5)._replace(name="other"), games=4, save=place)
    assert match.players == ("random", "other")
    assert match.tally.total.games == 4
    assert (place / "random-other.jsonl").exists()
    assert td.game("connect_four").num_actions == 7
    pool = td.arena("tic_tac_toe", ["random", "random", "random"], games=2)
    assert pool.players == ("random", "random #2", "random #3")
    with pytest.raises(td.UserError, match="games >= 1"):
        td.play_match("tic_tac_toe", "random", "random", games=0)
    with pytest.raises(td.UserError, match="at least two players"):
        td.arena("tic_tac_toe", ["random"])


def test_a_checkpoint_is_named_by_its_step(place):
    run = write_run(place / "runs/tic_tac_toe/alphazero/20260101-000000-a", algorithm="alphazero", environment="tic_tac_toe", seeds=1)
    shutil.copytree(trained_run("tic_tac_toe") / "policy", run / "policy", dirs_exist_ok=True)
    (run / "checkpoints" / "4000").mkdir(parents=True)
    for text in ("latest@4000", "20260101@4000", f"{run}@4000"):
        assert choose_player(text, "tic_tac_toe", place / "runs") == Path(f"{run}@4000")
    for text in ("latest@40", "latest@now", "latest@"):
        with pytest.raises(td.UserError, match=f"has no checkpoint of step {text[7:]}: it has those of 4000"):
            choose_player(text, "tic_tac_toe", place / "runs")
    with pytest.raises(td.UserError, match="has no checkpoint of step 5: it has those of 4000"):
        td.player(f"{run}@5", "tic_tac_toe")
    with pytest.raises(td.UserError, match="there is no player 'other@4000'"):
        choose_player("other@4000", "tic_tac_toe", place / "runs")
    named = run.rename(run.with_name("20260101-000000-me@4000"))
    assert choose_player(str(named), "tic_tac_toe", place / "runs") == named


@pytest.mark.slow
def test_a_trained_run_plays(place, capsys):
    run = td.train(
        "alphazero", "tic_tac_toe", steps=512, num_envs=8, settings={"learning_starts": 64, "batch_size": 32}, checkpoint_every=256
    ).run
    assert main(["arena", "tic_tac_toe", "latest", "random", "--games", "4", "--simulations", "8", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["players"][0]["player"] == f"{run.name}:simulations=8"
    assert main(["arena", "tic_tac_toe", "latest", "latest@256", "--games", "4", "--simulations", "0", "--json"]) == 0
    assert [row["player"] for row in json.loads(capsys.readouterr().out)["players"]] == [
        f"{run.name}:simulations=0",
        f"{run.name}@256:simulations=0",
    ]
    assert main(["arena", "connect_four", "latest", "random"]) == 2
    assert "was trained on tic_tac_toe, not on connect_four" in capsys.readouterr().err
    assert td.play_match("tic_tac_toe", run, td.load(run), games=2, simulations=0).tally.total.games == 2
