"""``thorndike clips``: a round by commands alone, and mistakes in one line."""

import json

import pytest

from thorndike.cli.main import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clips of random actions that wait to be judged."""
    where = tmp_path_factory.mktemp("clips") / "lake"
    assert main(["clips", "collect", "FrozenLake-v1", "--to", str(where), "--pairs", "3", "--length", "4", "--no-films"]) == 0
    return where


def answer(capsys, *words):
    capsys.readouterr()
    assert main([*map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_pairs_wait_then_a_program_judges_and_a_reward_is_learnt(folder, capsys):
    assert answer(capsys, "clips", "judge", folder)["judgements"] == 3
    found = answer(capsys, "clips", "fit", folder, "--set", "total_steps=20", "--set", "net_arch=4,4", "--set", "members=2")
    assert found["choices"] == 3 and found["near_chance"] and found["reward"] == str(folder / "rewards" / "0")
    assert main(["clips", "judge", str(folder), "--temperature", "0"]) == 0
    assert capsys.readouterr().out.startswith("0 choices made\nnext: thorndike clips fit")


def test_rounds_stop_where_people_must_judge(tmp_path, capsys):
    pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("pygame")
    words = [
        "clips",
        "train",
        "q_learning",
        "FrozenLake-v1",
        "--to",
        str(tmp_path / "c"),
        "--choices",
        "2",
        "--rounds",
        "1",
        "--length",
        "3",
    ]
    assert main(words) == 0
    told = capsys.readouterr().out
    assert told.startswith("round 1 of 1: 2 pairs of clips wait for you\nnext: thorndike language label --db")
    assert told.rstrip().endswith("then: the same command again")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["clips", "colect"], "did you mean 'collect'"),
        (["clips", "collect", "FrozenLake-v1"], "required: --to"),
        (["clips", "collect", "FrozenLak-v1", "--to", "x"], "did you mean 'FrozenLake-v1'"),
        (["clips", "collect", "FrozenLake-v1", "--to", "x", "--run", "none"], "no run"),
        (["clips", "judge", "nowhere"], "nowhere is no folder of clips"),
        (["clips", "judge", "x", "--error-rate", "2"], "expected a number from 0 to 1"),
        (["clips", "fit", "nowhere"], "nowhere is no folder of clips"),
        (["clips", "train", "ppo", "--to", "x"], "which environment?"),
        (["clips", "train", "ppo", "Pendulum-v1", "--to", "x", "--error-rate", "0.1"], "give --simulate"),
        (["clips", "train", "ppo", "Pendulum-v1", "--to", "x", "--reward-set", "member=3"], "did you mean 'members'"),
        (["clips", "train", "ppo", "Pendulum-v1", "--to", "x", "--choices", "3", "--simulate"], "two choices a round"),
        (["train", "ppo", "Pendulum-v1", "--reward", "nowhere"], "--reward nowhere holds no learnt reward"),
        (["train", "ppo", "Pendulum-v1", "--wrap", "learned_reward"], "--reward DIR"),
    ],
)
def test_a_mistake_is_one_line(words, why, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    told = capsys.readouterr().err
    assert why in told and told.count("\n") == 1, told


def test_a_folder_of_other_clips_and_one_without_choices_are_one_line(folder, capsys, tmp_path):
    assert main(["clips", "collect", "FrozenLake-v1", "--to", str(folder), "--length", "9", "--no-films"]) == 2
    assert "was begun with length = 4, not 9" in capsys.readouterr().err
    fresh = str(tmp_path / "fresh")
    assert main(["clips", "collect", "FrozenLake-v1", "--to", fresh, "--pairs", "1", "--length", "4", "--no-films"]) == 0
    assert main(["clips", "fit", fresh]) == 2
    assert "0 choices are too few" in capsys.readouterr().err
    assert main(["train", "q_learning", "FrozenLake-v1", "--reward", fresh]) == 2
    assert "no reward has been learnt" in capsys.readouterr().err
