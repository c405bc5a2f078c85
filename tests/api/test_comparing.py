"""``td.compare`` on run directories: made up ones, and one that was trained."""

import shutil

import numpy as np
import pytest

import thorndike as td
from made_up_runs import write_run
from thorndike.statistics.comparison import compare_scores, standing

HIGH, LOW = [500.0, 499.0, 500.0, 498.0, 500.0, 470.0], [301.0, 280.0, 310.0, 295.0, 320.0, 333.0]
OPTIONS = {"episodes": 2, "resamples": 2_000}


@pytest.fixture
def pair(tmp_path):
    return [write_run(tmp_path / "high", HIGH), write_run(tmp_path / "low", LOW, algorithm="dqn")]


def test_a_comparison_is_that_of_the_seeds_means(pair):
    found = td.compare(pair, **OPTIONS)
    expected = compare_scores(HIGH, LOW, resamples=2_000)
    assert (found.verdict, found.difference, found.ci95, found.more_seeds) == ("better", expected.difference, expected.ci95, 0)
    assert found.p_improvement == expected.p_improvement.value == 1.0
    first, baseline = found.runs
    assert (first.label, first.scores, first.difference) == ("ppo", {"CartPole-v1": tuple(HIGH)}, expected)
    assert (baseline.label, baseline.difference) == ("dqn", None)
    assert first.standing == standing(HIGH, resamples=2_000)


def test_the_metric_and_the_threshold_are_ones_choice(pair):
    found = td.compare(pair, metric="mean", failed_below=480.0, **OPTIONS)
    assert found.difference == pytest.approx(np.mean(HIGH) - np.mean(LOW))
    assert [side.standing.failed.value for side in found.runs] == [pytest.approx(1 / 6), 1.0]


def test_several_learners_are_compared_with_one_baseline(pair, tmp_path):
    third = write_run(tmp_path / "third", HIGH[::-1], algorithm="a2c")
    found = td.compare([*pair, third], against=pair[1], **OPTIONS)
    assert {side.label: side.difference and side.difference.verdict for side in found.runs} == {
        "ppo": "better",
        "dqn": None,
        "a2c": "better",
    }
    assert found.baseline == "dqn"


def test_returns_of_several_environments_are_scaled_by_all_seeds_and_it_is_said(tmp_path):
    runs = [
        write_run(tmp_path / f"{algorithm}-{place}", list(np.array(scores) * factor), algorithm=algorithm, environment=place)
        for algorithm, scores in (("ppo", HIGH), ("dqn", LOW))
        for place, factor in (("CartPole-v1", 1.0), ("Big-v0", 1_000.0))
    ]
    found = td.compare(runs, failed_below={"CartPole-v1": 300.0, "Big-v0": 400_000.0}, **OPTIONS)
    assert found.environments == ("CartPole-v1", "Big-v0")
    assert any(note.startswith("the environments differ (CartPole-v1, Big-v0): returns are scaled to 0..1") for note in found.notes)
    scaled = (np.array([HIGH, LOW]) - 280.0) / 220.0
    assert found.runs[0].standing.mean.value == pytest.approx(scaled[0].mean())
    assert found.difference == pytest.approx(scaled[0][[0, 1, 3]].mean() - scaled[1][[0, 2, 4]].mean(), rel=0.2)
    assert found.runs[1].standing.failed.value == pytest.approx((2 + 6) / 12)
    with pytest.raises(td.UserError, match="failed_below has no return for Big-v0"):
        td.compare(runs, failed_below={"CartPole-v1": 300.0}, **OPTIONS)


def test_of_unequal_numbers_of_seeds_the_first_count_and_it_is_said(tmp_path):
    runs = [
        write_run(tmp_path / f"{algorithm}-{place}", scores, algorithm=algorithm, environment=place)
        for algorithm, place, scores in (("ppo", "A-v0", HIGH), ("ppo", "B-v0", HIGH[:5]), ("dqn", "A-v0", LOW), ("dqn", "B-v0", LOW))
    ]
    found = td.compare(runs, **OPTIONS)
    assert [side.standing.seeds for side in found.runs] == [5, 6]
    assert "ppo has different numbers of seeds (6 on A-v0, 5 on B-v0): the first 5 of each count" in found.notes


def test_more_seeds_are_pooled(tmp_path, pair):
    more = write_run(tmp_path / "more", LOW[::-1], algorithm="dqn", seed=1)
    found = td.compare({"new": pair[0], "old": [pair[1], more]}, **OPTIONS)
    assert found.runs[1].scores == {"CartPole-v1": tuple(LOW + LOW[::-1])}
    assert found.baseline == "old"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """One trained run, and the same under another name."""
    folder = tmp_path_factory.mktemp("runs")
    run = td.train("q_learning", "FrozenLake-v1", steps=500, seeds=2, preset="none", output=folder, name="one").run
    return run, shutil.copytree(run, run.with_name(run.name.replace("one", "two")))


def test_what_was_not_evaluated_is_evaluated_now_and_recorded(trained):
    found = td.compare(trained, episodes=3, resamples=100)
    assert (found.verdict, found.difference, found.more_seeds) == ("cannot tell", 0.0, None)
    assert found.notes == ("one and two have the same settings and the same seed: they are the same agents, trained twice",)
    for run in trained:
        assert len((run / "evaluations.jsonl").read_text().splitlines()) == 2 * 3
    assert td.compare(trained, episodes=2, resamples=100).runs[0].scores == found.runs[0].scores
    for run in trained:
        assert len((run / "evaluations.jsonl").read_text().splitlines()) == 2 * 3


def test_a_comparison_draws_itself(trained, tmp_path):
    path = td.compare(trained, episodes=2, resamples=100).plot(tmp_path / "both.svg")
    assert "sample efficiency, FrozenLake-v1" in path.read_text()
