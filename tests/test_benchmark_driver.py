"""The benchmark driver: what it makes of raw records, and where its tables go. No contestant is started."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from thorndike.games.tic_tac_toe import TIC_TAC_TOE

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def load(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


def test_median_ignores_failed_runs_and_keeps_the_spread(load):
    records = [{"steps_per_cpu_s": 10.0}, {"error": "exit 1: boom"}, {"steps_per_cpu_s": 30.0}]
    summary = load("run").summary(records)
    assert summary["steps_per_cpu_s"] == 20.0
    assert summary["steps_per_cpu_s_range"] == [10.0, 30.0]
    assert summary["failed"] == 1


@pytest.mark.parametrize(("times", "median"), [([5.0, 7.0, None], 7.0), ([5.0, None, None], None)])
def test_a_threshold_not_reached_is_later_than_all_others(load, times, median):
    records = [{"cpu_s": seconds, "reached": seconds is not None} for seconds in times]
    assert load("run").summary(records)["cpu_s"] == median


def test_a_claim_is_a_ratio_of_medians_with_each_round_beside_it(load):
    records = {"a": [{"steps_per_cpu_s": 90.0}, {"steps_per_cpu_s": 110.0}], "b": [{"steps_per_cpu_s": 10.0}, {"steps_per_cpu_s": 10.0}]}
    run = load("run")
    summaries = {name: run.summary(runs) for name, runs in records.items()}
    claim = run.judge(load("contestants").Claim("a", "b", at_least=11.0), summaries, records)
    assert (claim["value"], claim["each_round"], claim["met"]) == (10.0, [9.0, 11.0], False)


def test_tables_replace_only_what_stands_between_their_markers(load):
    tables = load("tables")
    text = "before\n<!-- bench:ppo -->\nold\n<!-- /bench:ppo -->\nafter\n"
    assert tables.between_markers(text, "ppo", "new") == "before\n<!-- bench:ppo -->\nnew\n<!-- /bench:ppo -->\nafter\n"
    with pytest.raises(ValueError, match="bench:dqn"):
        tables.between_markers(text, "dqn", "new")


def test_the_performance_page_has_markers_for_every_task(load):
    page = (BENCHMARKS.parent / "docs" / "performance.md").read_text()
    for task in load("contestants").TASKS:
        assert f"<!-- bench:{task.name} -->" in page and f"<!-- /bench:{task.name} -->" in page


def test_every_claim_and_script_exists(load):
    for task in load("contestants").TASKS:
        names = {contestant.name for contestant in task.contestants}
        assert {claim.of for claim in task.claims} | {claim.versus for claim in task.claims if claim.versus} <= names
        scripts = [word for contestant in task.contestants for word in contestant.command if word.startswith("benchmarks/")]
        assert all((BENCHMARKS.parent / script).exists() for script in scripts)


def test_mean_over_log_points_needs_a_hundred_episodes(load):
    points = [{"rollout/episodes": [80.0], "rollout/ep_rew_mean": [100.0]}, {"rollout/episodes": [50.0], "rollout/ep_rew_mean": [230.0]}]
    recent_mean = load("thorndike_threshold").recent_mean
    assert recent_mean(points[:1]) is None
    assert recent_mean(points) == pytest.approx((80 * 100 + 50 * 230) / 130)


def test_the_driver_waits_for_a_process_and_counts_its_cpu(load):
    finished = load("processes").run_pinned(["python3", "-c", "sum(range(3_000_000)); print('{\"steps\": 1}')"], {}, None, 60.0)
    assert finished.exit_code == 0 and 0.01 < finished.cpu_s <= finished.wall_s * 1.5
    assert load("processes").last_json(finished.stdout) == {"steps": 1}


def test_a_contestant_that_hangs_is_killed(load):
    finished = load("processes").run_pinned(["sleep", "30"], {}, None, 0.2)
    assert finished.exit_code == -9 and finished.wall_s < 10


def test_games_side_by_side_are_lost_by_who_resigns(load, quick_compile):
    side_by_side = load("side_by_side")

    def first_legal(turns):
        return [int(np.flatnonzero(np.asarray(turn.game.legal(turn.position)))[0]) for turn in turns]

    def gives_up(turns):
        return [side_by_side.RESIGNS if len(turn.moves) >= 3 else move for turn, move in zip(turns, first_legal(turns), strict=True)]

    plays_on, resigns = side_by_side.Side("plays on", first_legal), side_by_side.Side("resigns", gives_up)
    assert side_by_side.play(TIC_TAC_TOE, resigns, plays_on, 6, 1).scores == [0.0] * 6
    assert side_by_side.play(TIC_TAC_TOE, plays_on, resigns, 6, 1).scores == [1.0] * 6
