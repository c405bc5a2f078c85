"""Curves come out of metrics.jsonl as they went in, and the pictures show them."""

import json
import xml.etree.ElementTree

import numpy as np
import pytest
from PIL import Image

from thorndike.errors import UserError
from thorndike.plotting.learning_curve import Curve, carried_forward, labels, plot_learning_curves, read_curve


def write_run(directory, rows, algorithm="ppo", environment="CartPole-v1", tail=""):
    directory.mkdir(parents=True)
    (directory / "run.json").write_text(json.dumps({"algorithm": algorithm, "environment": environment}))
    (directory / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + tail)
    return directory


def row(steps, *returns):
    return {"steps": steps, "wall_s": 1.0, "rollout/ep_rew_mean": list(returns)}


def curve(seeds=8, points=50, algorithm="ppo", environment="CartPole-v1", name="run", rise=1.0):
    steps = np.linspace(2048, 100_000, points)
    noise = np.random.default_rng(len(algorithm)).normal(0, 40, size=(points, seeds))
    values = 480 * (1 - np.exp(-steps / 30_000 * rise))[:, None] + noise
    return Curve(steps, values, algorithm, environment, name)


def test_a_run_is_read_with_its_seed_axis(tmp_path):
    run = write_run(tmp_path / "a", [row(100, 1.0, 2.0), row(200, 3.0, 4.0)])
    read = read_curve(run)
    assert read.steps.tolist() == [100, 200]
    assert read.values.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert (read.algorithm, read.environment, read.name) == ("ppo", "CartPole-v1", "a")


def test_points_without_any_value_and_a_half_written_line_are_left_out(tmp_path):
    rows = [row(100, None, float("nan")), row(200, None, 4.0), {"steps": 300, "time/fps": [1.0, 1.0]}]
    read = read_curve(write_run(tmp_path / "a", rows, tail='{"steps": 400, "rollo'))
    assert read.steps.tolist() == [200]
    assert np.isnan(read.values[0, 0])
    assert read.values[0, 1] == 4.0


def test_what_is_measured_of_the_whole_run_is_a_single_line(tmp_path):
    rows = [{"steps": 100, "time/fps": None}, {"steps": 200, "time/fps": 5.0}]
    read = read_curve(write_run(tmp_path / "a", rows), "time/fps")
    assert (read.steps.tolist(), read.values.tolist()) == ([200], [[5.0]])


@pytest.mark.parametrize(
    ("rows", "metric", "message"),
    [
        ([], "rollout/ep_rew_mean", "has logged nothing yet"),
        ([row(1, 2.0)], "rollout/ep_rew_men", "has no metric 'rollout/ep_rew_men'; did you mean 'rollout/ep_rew_mean'"),
        ([row(1, None)], "rollout/ep_rew_mean", "no value of 'rollout/ep_rew_mean' yet"),
    ],
)
def test_a_run_with_nothing_to_draw_is_a_mistake_in_one_line(tmp_path, rows, metric, message):
    with pytest.raises(UserError, match=message) as raised:
        read_curve(write_run(tmp_path / "a", rows), metric)
    assert "\n" not in str(raised.value)


def test_a_seed_that_ended_no_episode_keeps_its_last_value():
    nan = np.nan
    filled = carried_forward(np.array([[nan, 1.0], [2.0, nan], [nan, nan], [3.0, 4.0]]))
    assert np.array_equal(filled, [[nan, 1.0], [2.0, 1.0], [2.0, 1.0], [3.0, 4.0]], equal_nan=True)


def test_an_unknown_ending_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"a plot is written as \.png, \.svg, \.pdf; got 'x\.gif'"):
        plot_learning_curves([curve()], tmp_path / "x.gif")


def test_the_legend_tells_runs_apart_with_few_words():
    assert labels([curve()]) == ["ppo, 8 seeds"]
    assert labels([curve(), curve(algorithm="dqn", seeds=1)]) == ["ppo, 8 seeds", "dqn, 1 seed"]
    assert labels([curve(name="a"), curve(name="b")]) == ["ppo (a), 8 seeds", "ppo (b), 8 seeds"]
    assert labels([curve(), curve(environment="Acrobot-v1")]) == ["ppo on CartPole-v1, 8 seeds", "ppo on Acrobot-v1, 8 seeds"]


def test_a_png_shows_line_and_band_in_the_first_colour(tmp_path):
    path = plot_learning_curves([curve()], tmp_path / "deep" / "curve.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    line = np.abs(pixels.astype(int) - [0x00, 0x72, 0xB2]).sum(axis=1) < 12
    assert line.sum() > 200
    assert len(np.unique(pixels, axis=0)) > 50


def test_an_svg_names_its_axes_and_is_the_same_each_time(tmp_path):
    curves = [curve(), curve(algorithm="dqn", seeds=1, rise=0.4)]
    first = plot_learning_curves(curves, tmp_path / "a.svg").read_text()
    second = plot_learning_curves(curves, tmp_path / "b.svg").read_text()
    assert first == second
    xml.etree.ElementTree.fromstring(first)
    for text in ("environment steps of each seed", "mean return of training episodes", "ppo, 8 seeds", "dqn, 1 seed"):
        assert text in first
