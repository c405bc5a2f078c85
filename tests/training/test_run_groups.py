"""Runs are sorted into sides, and what would make a comparison unfair is said or refused."""

import json
import os

import pytest

from made_up_runs import write_evaluation, write_run
from thorndike.errors import UserError
from thorndike.training.run_groups import group_runs, recorded_scores

STAMP = "20260101-120000-"


def read(run):
    """The run as a side's only one."""
    other = write_run(run.parent / f"{run.name}-other", [1.0], algorithm="other")
    (trained,) = group_runs([run, other]).groups[0].runs.values()
    return trained[0]


def sides(found):
    return {
        group.label: {place: [str(trained.run.name) for trained in runs] for place, runs in group.runs.items()} for group in found.groups
    }


def test_a_run_is_a_side_called_after_its_algorithm_and_the_last_is_the_baseline(tmp_path):
    found = group_runs([write_run(tmp_path / "a", [1.0]), write_run(tmp_path / "b", [1.0], algorithm="dqn")])
    assert sides(found) == {"ppo": {"CartPole-v1": ["a"]}, "dqn": {"CartPole-v1": ["b"]}}
    assert (found.baseline, found.environments, found.notes) == ("dqn", ("CartPole-v1",), ())


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        (["base", "tuned"], ["base", "tuned"]),
        (["run", "run-2"], ["run", "run-2"]),
    ],
)
def test_runs_of_one_algorithm_are_called_by_their_names(tmp_path, names, labels):
    runs = [write_run(tmp_path / f"{STAMP}{name}", [1.0], seed=number) for number, name in enumerate(names)]
    assert list(sides(group_runs(runs))) == labels


def test_runs_with_equal_names_are_called_by_their_directories(tmp_path):
    runs = [write_run(tmp_path / f"2026010{number}-120000-run", [1.0], seed=number) for number in (1, 2)]
    assert list(sides(group_runs(runs))) == ["20260101-120000-run", "20260102-120000-run"]


def test_runs_of_one_algorithm_on_several_environments_are_one_side(tmp_path):
    runs = [
        write_run(tmp_path / f"{algorithm}-{place}", [1.0], algorithm=algorithm, environment=place)
        for algorithm in ("ppo", "dqn")
        for place in ("CartPole-v1", "Acrobot-v1")
    ]
    found = group_runs(runs)
    assert sides(found)["ppo"] == {"CartPole-v1": ["ppo-CartPole-v1"], "Acrobot-v1": ["ppo-Acrobot-v1"]}
    assert found.environments == ("CartPole-v1", "Acrobot-v1")


def test_an_environment_that_not_all_were_trained_on_is_left_out_and_said(tmp_path):
    runs = [write_run(tmp_path / "a", [1.0]), write_run(tmp_path / "b", [1.0], environment="Acrobot-v1")]
    found = group_runs([*runs, write_run(tmp_path / "c", [1.0], algorithm="dqn")])
    assert found.environments == ("CartPole-v1",)
    assert found.notes == ("the environments differ: Acrobot-v1 left out, as not every learner was trained there",)


def test_the_same_id_with_other_arguments_is_another_environment(tmp_path):
    slippery = write_run(tmp_path / "a", [1.0], environment="FrozenLake-v1")
    dry = write_run(tmp_path / "b", [1.0], environment="FrozenLake-v1", algorithm="dqn", env_kwargs={"is_slippery": False})
    with pytest.raises(UserError, match=r"environments differ.*ppo on FrozenLake-v1; dqn on FrozenLake-v1 \(is_slippery=False\)"):
        group_runs([slippery, dry])


def test_runs_given_together_are_more_seeds_of_one_learner(tmp_path):
    first, second = (write_run(tmp_path / name, [1.0], seed=seed) for name, seed in (("a", 0), ("b", 1)))
    other = write_run(tmp_path / "c", [1.0], algorithm="dqn")
    assert sides(group_runs([[first, second], other]))["ppo"] == {"CartPole-v1": ["a", "b"]}
    assert sides(group_runs({"mine": [first, second], "theirs": other}))["mine"] == {"CartPole-v1": ["a", "b"]}


def test_the_baseline_is_a_run_a_label_or_a_run_more(tmp_path):
    runs = [write_run(tmp_path / name, [1.0], algorithm=name) for name in ("ppo", "dqn", "a2c")]
    assert group_runs(runs, runs[0]).baseline == "ppo"
    assert group_runs(runs[:2], runs[2]).baseline == "a2c"
    assert group_runs(runs[:1], runs[2]).baseline == "a2c"
    assert group_runs({"mine": runs[0], "theirs": runs[1]}, "mine").baseline == "mine"


def test_what_makes_a_comparison_unfair_is_said(tmp_path):
    first = write_run(tmp_path / "a", [1.0], steps=1_000)
    longer = write_run(tmp_path / "b", [1.0], steps=5_000, algorithm="dqn", status="interrupted")
    steps, status = group_runs([first, longer]).notes
    assert steps == "trained for different numbers of steps on CartPole-v1: ppo 1,000, dqn 5,000"
    assert status.endswith("b is not finished: its status is interrupted")
    again = write_run(tmp_path / "c", [1.0], steps=1_000)
    assert group_runs([first, again]).notes == (
        "a and c have the same settings and the same seed: they are the same agents, trained twice",
    )


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"config": {"gamma": 0.5}, "seed": 1}, "not seeds of the same learner: gamma is 0.99 and 0.5"),
        ({"algorithm": "dqn", "seed": 1}, "not seeds of the same learner: algorithm is ppo and dqn"),
        ({"seed": 0}, "hold the same agents, those of seed 0"),
    ],
)
def test_runs_that_are_no_seeds_of_one_learner_are_not_pooled(tmp_path, facts, message):
    together = [write_run(tmp_path / "a", [1.0]), write_run(tmp_path / "b", [1.0], **facts)]
    with pytest.raises(UserError, match=message):
        group_runs([together, write_run(tmp_path / "c", [1.0], algorithm="a2c")])


def test_one_run_or_one_run_twice_is_no_comparison(tmp_path):
    run = write_run(tmp_path / "a", [1.0])
    with pytest.raises(UserError, match="at least two learners to compare, got ppo on CartPole-v1"):
        group_runs([run])
    with pytest.raises(UserError, match="at least two learners to compare, got none"):
        group_runs([])
    with pytest.raises(UserError, match="was given twice"):
        group_runs([run, run])
    with pytest.raises(UserError, match="is no run"):
        group_runs([run, tmp_path])


def test_a_run_without_a_policy_is_refused(tmp_path):
    run = write_run(tmp_path / "a")
    (run / "policy" / "manifest.json").unlink()
    (run / "policy").rmdir()
    with pytest.raises(UserError, match="has no trained policy to compare"):
        group_runs([run, run])


def test_recorded_scores_are_the_means_of_the_seeds_last_evaluation(tmp_path):
    run = write_run(tmp_path / "a", [10.0, 20.0], episodes=4)
    write_evaluation(run, [30.0, 40.0], episodes=3)
    trained = read(run)
    assert recorded_scores(trained, 3) == [30.0, 40.0]
    assert recorded_scores(trained, 4) is None


def test_half_a_line_at_the_end_is_not_there(tmp_path):
    run = write_run(tmp_path / "a", [10.0, 20.0])
    with (run / "evaluations.jsonl").open("a") as file:
        file.write('{"evaluation_seed": 0, "determ')
    assert recorded_scores(read(run), 2) == [10.0, 20.0]


def test_an_evaluation_of_some_seeds_or_of_the_exploring_policy_does_not_count(tmp_path):
    run = write_run(tmp_path / "a", [10.0, 20.0, 30.0])
    trained = read(run)
    write_evaluation(run, [1.0, 2.0])
    assert recorded_scores(trained, 2) is None
    write_evaluation(run, [1.0, 2.0, 3.0])
    assert recorded_scores(trained, 2) == [1.0, 2.0, 3.0]
    write_evaluation(run, [4.0, 5.0, 6.0], deterministic=False)
    assert recorded_scores(trained, 2) is None


def test_an_evaluation_made_before_the_policy_was_written_does_not_count(tmp_path):
    run = write_run(tmp_path / "a", [10.0])
    trained = read(run)
    assert recorded_scores(trained, 1) == [10.0]
    later = (run / "evaluations.jsonl").stat().st_mtime + 1
    os.utime(run / "policy" / "manifest.json", (later, later))
    assert recorded_scores(trained, 1) is None


def test_damaged_evaluations_are_a_mistake_in_one_line(tmp_path):
    run = write_run(tmp_path / "a", [10.0])
    (run / "evaluations.jsonl").write_text('{"half": \n' + json.dumps({}) + "\n")
    with pytest.raises(UserError, match=r"evaluations\.jsonl is damaged") as raised:
        recorded_scores(read(run), 1)
    assert "\n" not in str(raised.value)
