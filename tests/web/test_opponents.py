"""Who is offered for which game, and that they play."""

import hashlib
import json
import shutil
from pathlib import Path

import jax
import pytest

from made_up_runs import write_run
from thorndike.cli.choose_player import choose_player
from thorndike.errors import UserError
from thorndike.games.game import Turn
from thorndike.games.registry import game
from thorndike.games.saved_game import saved_game_file
from thorndike.games.trained import trained_run
from thorndike.training.json_files import as_bytes
from thorndike.web import opponents as module
from thorndike.web.opponents import PERSON, opponents_in
from thorndike.web.studio import MOST_TABLES, Setup, Studio


def names(game_id, folder):
    return [each.name for each in opponents_in(folder)(game_id)]


def test_runs_of_this_game_come_first_the_newest_before_the_others(tmp_path):
    for name, environment in (
        ("20260101-000000-old", "tic_tac_toe"),
        ("20260102-000000-new", "tic_tac_toe"),
        ("20260103-000000-x", "othello"),
    ):
        write_run(tmp_path / environment / "alphazero" / name, algorithm="alphazero", environment=environment, seeds=1)
    found = names("tic_tac_toe", tmp_path)
    assert found[:2] == ["Trained: alphazero, 20260102-000000-new", "Trained: alphazero, 20260101-000000-old"]
    assert found[2:4] == ["Trained: Thorndike's own", "Tree search, without a network"]
    assert found[-1] == "Random moves"


def test_checkpoints_before_the_newest_are_offered_too(tmp_path):
    run = write_run(tmp_path / "a" / "ppo" / "20260101-000000-old", environment="tic_tac_toe", seeds=1)
    for step in (4000, 12000, 800):
        (run / "checkpoints" / str(step)).mkdir(parents=True)
    offered = opponents_in(tmp_path)("tic_tac_toe")
    assert [each.name for each in offered[:3]] == [
        "Trained: ppo, 20260101-000000-old",
        "Trained: ppo, 20260101-000000-old, at step 4,000",
        "Trained: ppo, 20260101-000000-old, at step 800",
    ]
    assert [each.id for each in offered[1:3]] == [f"{run}@4000", f"{run}@800"]


def test_a_damaged_run_is_left_out(tmp_path):
    run = write_run(tmp_path / "a" / "20260101-000000-old", environment="tic_tac_toe", seeds=1)
    (run / "run.json").write_text("{")
    assert names("tic_tac_toe", tmp_path)[0] == "Trained: Thorndike's own"


def test_no_search_where_there_is_none_or_it_takes_too_long(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "program_of", lambda engine: "/usr/games/it")
    assert names("2048", tmp_path) == []
    assert names("backgammon", tmp_path) == ["GNU Backgammon", "Random moves"]
    assert names("chess", tmp_path) == ["Stockfish", "Fairy-Stockfish", "Random moves"]
    assert names("go_9x9", tmp_path) == ["Tree search, without a network", "GNU Go", "Pachi", "Random moves"]


def test_a_program_that_is_not_installed_is_not_offered(tmp_path, monkeypatch):
    def missing(engine):
        raise UserError("it is not installed")

    monkeypatch.setattr(module, "program_of", missing)
    assert names("chess", tmp_path) == ["Random moves"]


def test_an_opponent_plays_under_its_name(tmp_path):
    made = game("tic_tac_toe")
    player = opponents_in(tmp_path)("tic_tac_toe")[-1].make(made, 16)
    assert player.name == "Random moves"
    assert player.choose(Turn(made, made.init(jax.random.key(0)), ())).action in range(9)


@pytest.fixture
def rooms(tmp_path):
    return Studio(("tic_tac_toe",), opponents_in(tmp_path))


def test_tables_have_names_that_nobody_guesses_and_the_oldest_make_room(rooms):
    made = [rooms.open(Setup("tic_tac_toe")) for _ in range(MOST_TABLES + 2)]
    assert len(set(made)) == len(made) and all(len(name) == 12 for name in made)
    assert [rooms.place(name) is None for name in made] == [True, True] + [False] * MOST_TABLES
    rooms.close()
    with pytest.raises(UserError, match="no longer on the table"):
        rooms.swap_sides(made[0])


def test_nobody_unknown_sits_down(rooms):
    with pytest.raises(UserError, match="nobody called stranger plays tic_tac_toe"):
        rooms.open(Setup("tic_tac_toe", "stranger"))


def test_swapping_sides_is_remembered_by_the_setup(rooms):
    name = rooms.open(Setup("tic_tac_toe", PERSON))
    rooms.swap_sides(name)
    place = rooms.place(name)
    assert not place.setup.person_begins and [seat.name for seat in place.table.view().seats] == ["Second", "First"]


def test_a_saved_game_of_another_studio_is_refused(rooms):
    text = b'{"format": "thorndike-game", "version": 1, "game": "chess", "seed": 0, "players": [], "moves": [], "win_probabilities": []}'
    with pytest.raises(UserError, match="holds a game of chess, which this studio does not have"):
        rooms.open_saved(text, "the file")


def test_a_game_of_ones_own_is_played_and_saved_and_opened(tmp_path):
    name = f"{Path(__file__).parents[2] / 'examples/own_game.py'}:NIM"
    offered = opponents_in(tmp_path)
    assert [each.id for each in offered(name)] == ["mcts", "random"]
    rooms = Studio((name,), offered)
    place = rooms.place(rooms.open(Setup(name)))
    view = place.table.view()
    data = saved_game_file(place.table.game, 0, ["A", "B"], view.names, view.choices)
    assert rooms.place(rooms.open_saved(data, "the file")).setup.game == name


def test_a_run_on_a_game_of_ones_own_is_found_by_any_way_to_its_file_and_sits_down(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text("from thorndike.games.tic_tac_toe import TIC_TAC_TOE as MINE\n")
    name = f"{tmp_path}/mine.py:MINE"
    run = write_run(tmp_path / "runs/mine/alphazero/20260101-000000-own", algorithm="alphazero", environment=name, seeds=1)
    policy = shutil.copytree(trained_run("tic_tac_toe") / "policy", run / "policy", dirs_exist_ok=True)
    facts, manifest = (json.loads((policy / file).read_text()) for file in ("policy.json", "manifest.json"))
    text = json.dumps(facts | {"environment": name}).encode()
    manifest["files"]["policy.json"] = {"bytes": len(text), "sha256": hashlib.sha256(text).hexdigest()}
    (policy / "policy.json").write_bytes(text)
    (policy / "manifest.json").write_bytes(as_bytes(manifest))
    monkeypatch.chdir(tmp_path)
    first = opponents_in(Path("runs"))("mine.py:MINE")[0]
    assert first.make(game("mine.py:MINE"), 4).name == "alphazero, 20260101-000000-own"
    assert choose_player("latest", "mine.py:MINE", Path("runs")).resolve() == run
