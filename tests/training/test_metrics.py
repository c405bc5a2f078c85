"""The log: one JSON line a log point, a number a seed, null where there is none."""

import json

import jax.numpy as jnp
import pytest

from thorndike.training.metrics import MetricsLog
from thorndike.training.segment import Report
from thorndike.types import EpisodeStats


def report(episodes, returns, loss=(1.0, 2.0)) -> Report:
    numbers = (jnp.array(x, jnp.float32) for x in (episodes, returns, episodes, (64, 64)))
    return Report({"train/loss": jnp.array(loss)}, EpisodeStats(*numbers))


def test_a_line_has_a_number_a_seed_and_null_where_no_episode_ended(tmp_path):
    log = MetricsLog(tmp_path, 10.0, 20.0)
    point = log.write(report((2, 0), (30, 0)), 64)
    log.write(report((1, 4), (7, 8), loss=(float("nan"), float("inf"))), 128)
    log.close()
    first, second = (json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines())
    assert (first["steps"], second["steps"]) == (64, 128)
    assert first["rollout/ep_rew_mean"] == [15.0, None]
    assert first["rollout/ep_len_mean"] == [1.0, None]
    assert first["rollout/episodes"] == [2.0, 0.0]
    assert first["train/loss"] == [1.0, 2.0]
    assert second["train/loss"] == [None, None], "JSON has no NaN"
    assert point.returns == [15.0]
    assert second["wall_s"] >= first["wall_s"] >= 10.0
    assert second["cpu_s"] >= first["cpu_s"] >= 20.0


def test_the_speed_counts_the_steps_of_all_seeds(tmp_path):
    log = MetricsLog(tmp_path, 0.0, 0.0)
    log.write(report((1, 1), (1, 1)), 64)
    log.write(report((1, 1), (1, 1)), 128)
    log.close()
    first, second = (json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines())
    assert first["time/fps"] is None
    assert second["time/fps"] == pytest.approx(2 * 64 / (second["wall_s"] - first["wall_s"]), rel=1e-6)
