"""A sweep's files: what is written is read again, half a line is dropped, damage is one line."""

import json
import math

import pytest

from thorndike.errors import UserError
from thorndike.training.sweep_directory import TrialRow, add_trials, find_sweep, new_sweep_directory, read_sweep, read_trials

SETTINGS, FAILED = {"gamma": 0.9, "net_arch": (8, 8)}, "train/loss is not finite by step 50"
ROW = TrialRow(0, 100, SETTINGS, (1.5, None), (None, FAILED), (50, 100), ((1.0, None), (1.0, None)))


def test_trials_are_read_as_they_were_written(tmp_path):
    add_trials(tmp_path, [ROW])
    add_trials(tmp_path, [ROW._replace(trial=1)])
    assert read_trials(tmp_path, 2) == {0: ROW, 1: ROW._replace(trial=1)}


def test_half_a_line_is_dropped_and_the_next_one_stands_on_its_own(tmp_path):
    add_trials(tmp_path, [ROW])
    with (tmp_path / "trials.jsonl").open("a") as file:
        file.write('{"trial": 1, "ste')
    assert set(read_trials(tmp_path, 2)) == {0}
    add_trials(tmp_path, [ROW._replace(trial=1)])
    assert set(read_trials(tmp_path, 2)) == {0, 1}


def test_a_mean_is_over_the_seeds_that_did_not_fail():
    assert ROW.mean == 1.5 and math.isnan(ROW._replace(scores=(None, None)).mean)


@pytest.mark.parametrize("change", [{"scores": [1.0]}, {"scores": ["a", "b"]}, {"trial": -1}, {"settings": []}, {"curve": 3}])
def test_a_damaged_line_is_told_in_one_line(tmp_path, change):
    line = {**ROW._asdict(), **change}
    (tmp_path / "trials.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(UserError, match="is damaged"):
        read_trials(tmp_path, 2)


@pytest.mark.parametrize("content", ["{}", "[]", "{", '{"format": 99}', '{"format": 1, "algorithm": 3}'])
def test_a_damaged_sweep_is_told_in_one_line(tmp_path, content):
    (tmp_path / "sweep.json").write_text(content)
    with pytest.raises(UserError) as caught:
        read_sweep(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_sweep_is_found_by_its_path_a_part_of_it_or_as_the_latest(tmp_path):
    first, second = (new_sweep_directory(tmp_path, "CartPole-v1", "ppo", name) for name in ("one", "two"))
    for sweep in (first, second):
        (sweep / "sweep.json").write_text("{}")
    assert find_sweep(str(first), tmp_path) == first == find_sweep("one", tmp_path)
    assert find_sweep("latest", tmp_path) == second
    with pytest.raises(UserError, match="fits 2 sweeps"):
        find_sweep("sweep-ppo", tmp_path)
    with pytest.raises(UserError, match="there is no sweep"):
        find_sweep("x", tmp_path / "empty")
