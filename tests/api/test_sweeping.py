"""A sweep from what was asked for to the winner on fresh seeds, interrupted and not."""

import json
import math

import pytest

import thorndike as td
from thorndike.api import sweep_trials, sweeping
from thorndike.api.sweep_trials import Group, batches, trials_at_once
from thorndike.errors import UserError
from thorndike.training.run_directory import read_run

pytestmark = pytest.mark.usefixtures("quick_compile")

GRID = {"learning_rate": [0.1, 0.5], "n_steps": [1, 4]}
QUICK = {"seeds": 2, "steps": 3_000, "episodes": 10, "fresh_seeds": 2}


def lake(output, over=None, **more):
    return td.sweep("q_learning", "FrozenLake-v1", over=over or GRID, output=output, **QUICK, **more)


@pytest.fixture(scope="module")
def swept(tmp_path_factory, quick_compile):
    return lake(tmp_path_factory.mktemp("swept"))


def test_every_combination_is_trained_and_scored_with_every_seed(swept):
    assert [row.settings for row in swept.trials] == [{"learning_rate": a, "n_steps": b} for a in (0.1, 0.5) for b in (1, 4)]
    assert all(len(row.scores) == 2 and all(0 <= score <= 1 for score in row.scores) for row in swept.trials)
    assert all(len(row.curve) == len(row.curve_steps) >= 10 and row.curve_steps[-1] >= 3_000 for row in swept.trials)


def test_the_winner_is_the_best_trial_run_again_on_other_seeds(swept):
    best = max(swept.trials, key=lambda row: row.mean)
    assert swept.winner.trial == best.trial and swept.winner.mean == best.mean
    record = read_run(swept.winner.run)
    assert record["sweep"] == str(swept.path) and record["status"] == "finished" and record["seeds"] == 2
    assert record["seed"] == swept.winner.seed != 0
    assert {name: record["config"][name] for name in GRID} == best.settings
    assert swept.winner.fresh.episodes == 100 and len(swept.winner.fresh.per_seed) == 2


def test_a_sweep_is_no_run_but_its_winner_is(swept):
    assert td.runs(swept.path.parents[2]) == [swept.winner.run]
    facts = json.loads((swept.path / "sweep.json").read_text())
    assert facts["status"] == "finished" and facts["winner"]["trial"] == swept.winner.trial and len(facts["effects"]) == 2


def test_the_picture_lies_beside_the_trials_and_can_be_drawn_elsewhere(swept, tmp_path):
    assert (swept.path / "response.png").read_bytes().startswith(b"\x89PNG")
    assert swept.plot(tmp_path / "again.svg").stat().st_size > 1_000


def test_an_interrupted_sweep_goes_on_to_the_same_numbers(swept, tmp_path, monkeypatch, capsys):
    kept, add_trials = [], sweeping.add_trials

    def add_one_batch(path, rows):
        if kept:
            raise KeyboardInterrupt
        kept.append(path)
        add_trials(path, rows)

    monkeypatch.setattr(sweeping, "add_trials", add_one_batch)
    with pytest.raises(KeyboardInterrupt):
        lake(tmp_path)
    path = kept[0]
    assert json.loads((path / "sweep.json").read_text())["status"] == "interrupted"
    assert "2 of 4 trials are kept; go on: thorndike sweep --resume" in capsys.readouterr().err
    monkeypatch.undo()
    resumed = td.resume_sweep(path)
    assert (path / "trials.jsonl").read_bytes() == (swept.path / "trials.jsonl").read_bytes()
    assert (resumed.effects, resumed.winner.fresh.per_seed) == (swept.effects, swept.winner.fresh.per_seed)


def test_a_finished_sweep_resumed_trains_nothing_again(swept, monkeypatch):
    def train_again(*arguments, **settings):
        raise AssertionError("trained again")

    monkeypatch.setattr(sweep_trials.TrialRunner, "run", train_again)
    monkeypatch.setattr(sweeping, "train", train_again)
    again = td.resume_sweep(swept.path)
    assert again.winner.run == swept.winner.run and again.winner.fresh.per_seed == swept.winner.fresh.per_seed


def test_a_trial_does_not_depend_on_the_trials_beside_it(swept, tmp_path):
    alone = lake(tmp_path, {"learning_rate": [0.3, 0.5], "n_steps": [1, 4]})
    for mine, other in zip(alone.trials[2:], swept.trials[2:], strict=True):
        assert mine.settings == other.settings and (mine.scores, mine.curve) == (other.scores, other.curve)


def test_a_lane_whose_numbers_are_not_finite_does_not_stop_the_others(tmp_path, monkeypatch):
    train_lanes = sweep_trials.train_lanes
    failing = ("train/td_error is not finite by step 10",)
    monkeypatch.setattr(
        sweep_trials,
        "train_lanes",
        lambda *given: (trained := train_lanes(*given))._replace(failures=failing + trained.failures[1:]),
    )
    found = lake(tmp_path, {"learning_rate": [0.1, 0.5]})
    assert found.trials[0].scores[0] is None and found.trials[0].failures == (failing[0], None)
    assert found.trials[0].mean == found.trials[0].scores[1] and not math.isnan(found.winner.mean)


def test_a_combination_that_cannot_be_is_told_before_anything_is_trained(tmp_path):
    with pytest.raises(UserError, match=r"trial 1 \(batch_size=48\) cannot be: .* choose a batch_size that divides 512"):
        td.sweep("ppo", "CartPole-v1", over={"batch_size": [64, 48]}, output=tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": -1}, "from 0 to 2"),
        ({"seeds": 0}, "at least 1"),
        ({"environment": len}, "a text names"),
        ({"algorithm": "pppo"}, "did you mean 'ppo'"),
        ({"preset": "missing"}, "no preset"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(change, words, tmp_path):
    asked = {"algorithm": "ppo", "environment": "CartPole-v1", "over": {"gamma": [0.9, 0.99]}, "output": tmp_path, **change}
    with pytest.raises(UserError, match=words):
        td.sweep(**asked)
    assert not list(tmp_path.iterdir())


def test_batches_are_of_one_size_and_as_equal_as_can_be():
    group = Group({}, {}, {}, [(i, {}) for i in range(9)])
    assert [(len(batch.trials), batch.size) for batch in batches([group], 8)] == [(5, 5), (4, 5)]
    assert [len(batch.trials) for batch in batches([group], 8, one_size=1)] == [1] * 9
    assert trials_at_once(5, "cpu") == 3 and trials_at_once(99, "cpu") == 1 and trials_at_once(4, "gpu") == 64


def test_host_environments_are_swept_too(tmp_path):
    found = td.sweep(
        "q_learning", "FrozenLake-v1", over={"gamma": [0.5, 0.9]}, engine="gymnasium", output=tmp_path, **{**QUICK, "steps": 200}
    )
    assert len(found.trials) == 2 and read_run(found.winner.run)["engine"] == "gymnasium"


def test_optuna_chooses_trials_and_goes_on_where_it_was(tmp_path, monkeypatch):
    pytest.importorskip("optuna")
    over, asked = {"learning_rate": "log(1e-3,1)"}, {"search": "optuna", "trials": 2}
    whole = lake(tmp_path / "whole", over, **asked)
    path = whole.path
    lines = (path / "trials.jsonl").read_bytes().splitlines(keepends=True)
    assert len(lines) == 2
    (path / "trials.jsonl").write_bytes(lines[0] + lines[1][:20])
    again = td.resume_sweep(path)
    assert (path / "trials.jsonl").read_bytes() == b"".join(lines)
    assert again.trials == whole.trials and {effect.verdict for effect in again.effects} == {"cannot tell"}


@pytest.mark.slow
def test_the_best_learning_rate_is_found_and_matters(tmp_path):
    found = td.sweep("ppo", "CartPole-v1", over={"learning_rate": [1e-6, 1e-3, 1.0]}, steps=50_000, seeds=4, fresh_seeds=4, output=tmp_path)
    assert found.winner.settings == {"learning_rate": 1e-3} and found.effects[0].verdict == "matters"
    assert found.winner.fresh.mean > 300
