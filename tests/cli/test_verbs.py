"""From training to film through the command line, on the smallest learner there is."""

import contextlib
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as imageio
import pytest

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.main import main

TRAINED = {"run", "status", "steps", "seeds", "wall_s", "cpu_s", "compile_s", "steps_per_s", "steps_per_cpu_s"}
EVALUATED = {"run", "environment", "protocol", "episodes", "mean", "iqm", "min", "ci95", "per_seed", "value_bias"}


def answer(words, capsys):
    """The JSON object of a command that ended well."""
    status = main([*words, "--json"])
    out, err = capsys.readouterr()
    assert status == 0, err
    assert out.count("\n") == 1
    return json.loads(out)


class Trained(NamedTuple):
    """The folder of runs, and what training printed."""

    output: Path
    printed: str


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    words = ["train", "q_learning", "FrozenLake-v1", "--steps", "3000", "--seeds", "2", "--gamma", "0.9", "--env-set", "is_slippery=False"]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main([*words, "--name", "tiny", "--output", str(folder), "--json"]) == 0
    return Trained(folder, printed.getvalue())


@pytest.fixture
def output(trained):
    return trained.output


def test_train_prints_one_object(trained):
    found = json.loads(trained.printed)
    assert set(found) == TRAINED
    assert (found["status"], found["seeds"]) == ("finished", 2)


def test_train_writes_a_run_with_its_command_and_settings(output):
    (run,) = output.glob("FrozenLake-v1/q_learning/*-tiny")
    facts = json.loads((run / "run.json").read_text())
    assert facts["status"] == "finished"
    assert facts["config"]["gamma"] == 0.9
    assert facts["command"].startswith("thorndike train q_learning FrozenLake-v1 --steps 3000")


def test_resume_trains_further(output, capsys):
    found = answer(["resume", "tiny", "--output", str(output), "--steps", "4000"], capsys)
    assert set(found) == TRAINED
    assert found["steps"] == 4000


def test_eval_scores_every_seed(output, capsys):
    found = answer(["eval", "tiny", "--output", str(output), "--episodes", "10"], capsys)
    assert set(found) == EVALUATED
    assert (found["environment"], found["episodes"], len(found["per_seed"])) == ("FrozenLake-v1", 10, 2)
    assert found["min"] == min(found["per_seed"])


def test_plot_draws_the_run(output, tmp_path, capsys):
    path = tmp_path / "curve.svg"
    assert answer(["plot", "tiny", "--output", str(output), "--file", str(path)], capsys)["plot"] == str(path)
    assert "q_learning, 2 seeds" in path.read_text()


def test_watch_films_an_episode_without_a_display(output, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    first = answer(["watch", "tiny", "--output", str(output)], capsys)["video"]
    second = answer(["watch", "tiny", "--output", str(output)], capsys)["video"]
    assert first != second
    assert imageio.imread(first, plugin="FFMPEG").shape[0] > 2


def test_bench_measures_and_leaves_nothing_behind(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = answer(["bench", "q_learning", "FrozenLake-v1", "--steps", "500", "--repeat", "1"], capsys)
    assert found["steps_per_s"] > 0
    assert os.listdir(tmp_path) == []


def test_settings_algorithms_presets_environments_and_info_are_listed(capsys):
    settings = answer(["list", "settings", "ppo"], capsys)["settings"]
    assert {"setting": "gamma", "default": "0.99", "value": "between 0 and 1", "meaning": "discount"} in settings
    assert {row["algorithm"] for row in answer(["list", "algorithms"], capsys)["algorithms"]} == set(ALGORITHMS)
    assert "CartPole-v1" in answer(["list", "environments"], capsys)["native"]
    assert any(row["environment"] == "CartPole-v1" for row in answer(["list", "presets"], capsys)["presets"])
    assert answer(["info"], capsys)["packages"]["jax"]


def test_an_environment_in_the_current_folder_is_found_and_its_prints_stay_out_of_json(tmp_path):
    (tmp_path / "my_room.py").write_text(
        "import gymnasium, os\n"
        "class Room(gymnasium.Env):\n"
        "    observation_space = gymnasium.spaces.Discrete(2)\n"
        "    action_space = gymnasium.spaces.Discrete(2)\n"
        "    def reset(self, seed=None, options=None):\n"
        "        print('hello'); os.write(1, b'hello from C')\n"
        "        return 0, {}\n"
        "    def step(self, action):\n"
        "        return 1, float(action), True, False, {}\n"
    )
    command = [sys.executable, "-c", "import sys; from thorndike.cli.main import main; sys.exit(main())"]
    words = ["train", "q_learning", "my_room:Room", "--steps", "200", "--json"]
    done = subprocess.run([*command, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert set(json.loads(done.stdout)) == TRAINED
    assert "hello from C" in done.stderr
