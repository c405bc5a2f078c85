"""``thorndike sweep``: its answers, its JSON, its mistakes."""

import json
import subprocess
import sys
import time

import pytest

from thorndike.cli.main import main

LAKE = ["sweep", "q_learning", "FrozenLake-v1"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def answer(runs):
    """The text of a small sweep, once for all."""
    script = "import sys; from thorndike.cli.main import main; sys.exit(main())"
    words = [*LAKE, "--over", "gamma=0.5,0.99", "--seeds", "2", "--steps", "3k", "--episodes", "10", "--fresh-seeds", "2"]
    more = ["--output", str(runs), "--name", "lake", "--plot", str(runs / "curve.svg")]
    done = subprocess.run([sys.executable, "-c", script, *words, *more], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_answer_names_the_best_its_fresh_score_and_what_matters(answer, runs):
    for words in ("best of 2 trials: gamma=", "which is optimistic", "on 2 fresh seeds (seed ", "gamma: cannot tell", "run: ", "sweep: "):
        assert words in answer
    assert (runs / "curve.svg").is_file()


def test_json_is_one_object_and_a_finished_sweep_resumed_says_the_same(answer, runs, capsys):
    assert main(["sweep", "--resume", "lake", "--output", str(runs), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["settings"] for row in told["trials"]] == [{"gamma": 0.5}, {"gamma": 0.99}]
    assert told["winner"]["seed"] != 0 and len(told["winner"]["fresh_per_seed"]) == 2 and told["search"] == "grid"
    assert told["effects"][0]["name"] == "gamma" and told["effects"][0]["verdict"] == "cannot tell"
    assert told["winner"]["run"] in answer


def test_other_verbs_see_the_winner_and_not_the_sweep(answer, runs, capsys):
    assert main(["list", "--output", str(runs), "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["runs"]
    assert len(listed) == 1 and "winner-of-" in listed[0]["run"]
    assert main(["show", "latest", "--output", str(runs)]) == 0


MISTAKES = [
    ([*LAKE], "needs a setting to vary"),
    ([*LAKE, "--over", "gamm=0.9,0.99"], "did you mean 'gamma'"),
    ([*LAKE, "--over", "gamma=0.9,1.5"], "between 0 and 1"),
    ([*LAKE, "--over", "gamma="], "has no value"),
    ([*LAKE, "--over", "variant=uniform(0,1)"], "has no range"),
    ([*LAKE, "--over", "gamma=0.9,0.99", "--trials", "5"], "has no use"),
    ([*LAKE, "--over", "gamma=0.9,0.99", "--set", "gamma=0.5"], "both fixed"),
    ([*LAKE, "--over", "total_steps=1,2"], "--steps"),
    ([*LAKE, "--over", "gamma=0.9,0.99", "--plot", "x.bmp"], ".png"),
    (["sweep", "ppo", "CartPol-v1", "--over", "gamma=0.9,0.99"], "did you mean 'CartPole-v1'"),
    (["sweep", "planning", "FrozenLake-v1", "--over", "gamma=0.9,0.99"], "nothing to sweep"),
    (["sweep", "--resume", "nothing"], "there is no sweep"),
    (["sweep", "ppo", "CartPole-v1", "--resume", "latest"], "leave algorithm out"),
    (["sweep", "--resume", "latest", "--fresh-seeds", "3"], "leave --fresh-seeds out"),
]


@pytest.mark.parametrize(("words", "told"), MISTAKES)
def test_a_mistake_is_one_line_and_status_2(words, told, tmp_path, capsys):
    assert main([*words, "--output", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert told in err and len(err.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_mistake_is_told_before_jax_is_imported():
    script = "import sys; from thorndike.cli.main import main; code = main(sys.argv[1:]); assert 'jax' not in sys.modules; sys.exit(code)"
    start = time.process_time()
    words = [*LAKE, "--over", "gamma=log(0.5,0.9)", "--over", "learning_rate=0,2"]
    done = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "learning_rate" in done.stderr, done.stderr
    assert time.process_time() - start < 0.5
