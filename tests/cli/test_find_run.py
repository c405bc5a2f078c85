"""A run is found by its path, as the latest, or by a part of its name."""

import json

import pytest

from thorndike.cli.find_run import find_run
from thorndike.cli.main import main
from thorndike.cli.show import last_evaluation
from thorndike.errors import UserError
from thorndike.training.run_listing import all_runs


@pytest.fixture
def output(tmp_path):
    for place in ("CartPole-v1/ppo/20260102-000000-first", "CartPole-v1/dqn/20260103-000000-deep", "ALE/Pong-v5/ppo/20260101-000000-run"):
        run = tmp_path / "runs" / place
        run.mkdir(parents=True)
        algorithm = run.parent.name
        facts = {"algorithm": algorithm, "environment": "E", "status": "finished", "steps": 5, "seeds": 2, "steps_done": 5, "config": {}}
        (run / "run.json").write_text(json.dumps(facts))
        (run / "metrics.jsonl").write_text('{"steps": 5, "rollout/ep_rew_mean": [1.0, null]}\n{"steps": 6, "rol')
    return tmp_path / "runs"


def test_runs_are_listed_oldest_first(output):
    assert [run.name for run in all_runs(output)] == ["20260101-000000-run", "20260102-000000-first", "20260103-000000-deep"]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("latest", "20260103-000000-deep"),
        ("first", "20260102-000000-first"),
        ("CartPole-v1/dqn", "20260103-000000-deep"),
        ("Pong", "20260101-000000-run"),
    ],
)
def test_a_run_is_found_by_a_part_of_its_path(output, text, name):
    assert find_run(text, output).name == name


def test_a_path_inside_a_run_means_the_run(output):
    run = all_runs(output)[0]
    assert find_run(str(run), output) == find_run(str(run / "run.json"), output) == run


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ppo", "'ppo' fits 2 runs under"),
        ("lattest", "did you mean 'latest'"),
        ("zzzzzz", "`thorndike list` shows the runs"),
    ],
)
def test_what_is_not_one_run_is_a_mistake(output, text, message):
    with pytest.raises(UserError, match=message):
        find_run(text, output)


def test_list_and_show_need_only_the_files(output, capsys):
    assert main(["list", "--output", str(output)]) == 0
    assert "20260103-000000-deep" in capsys.readouterr().out
    assert main(["list", "--output", str(output), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["runs"]
    assert [(row["algorithm"], row["mean_return"]) for row in rows] == [("ppo", 1.0), ("ppo", 1.0), ("dqn", 1.0)]
    assert main(["show", "first", "--output", str(output)]) == 0
    assert "finished" in capsys.readouterr().out


def test_a_damaged_run_is_one_line(output, capsys):
    (all_runs(output)[-1] / "run.json").write_text("{")
    assert main(["show", "latest", "--output", str(output)]) == 2
    assert "run.json is damaged" in capsys.readouterr().err


def test_only_the_last_evaluation_counts(tmp_path):
    path = tmp_path / "evaluations.jsonl"
    assert last_evaluation(path) is None
    rows = [(0, 0, -9), (0, 1, -9), (1, 0, -9), (1, 1, -9), (0, 0, 1), (0, 1, 3), (1, 0, 5), (1, 1, 7)]
    path.write_text("".join(json.dumps({"seed": s, "episode": e, "return": r}) + "\n" for s, e, r in rows))
    found = last_evaluation(path)
    assert (found["episodes"], found["mean"], found["min"]) == (2, 4.0, 2.0)
