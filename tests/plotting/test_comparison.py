"""The picture of a comparison shows every side, and what is not there to draw is left out."""

import xml.etree.ElementTree

import numpy as np
import pytest
from PIL import Image

from made_up_runs import write_run
from thorndike.errors import UserError
from thorndike.plotting.comparison import Side, plot_comparison, read_curves
from thorndike.plotting.learning_curve import Curve
from thorndike.plotting.style import COLOURS
from thorndike.statistics.comparison import standing


def side(label, level, seeds=8, environments=("CartPole-v1",), points=30):
    generator = np.random.default_rng(seeds)
    scores = generator.normal(level, 0.1, size=(seeds, len(environments)))
    steps = np.linspace(1_000, 100_000, points)
    values = level * (1 - np.exp(-steps / 30_000))[:, None] + generator.normal(0, 0.1, size=(points, seeds))
    curves = {place: [Curve(steps, values, label, place, label)] for place in environments}
    return Side(label, scores, standing(scores, resamples=500), curves)


def test_a_png_shows_every_side_in_its_colour(tmp_path):
    sides = [side("new", 0.9), side("old", 0.5, seeds=5), side("older", 0.2, seeds=3)]
    path = plot_comparison(sides, ["CartPole-v1"], tmp_path / "deep" / "all.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3).astype(int)
    for colour in COLOURS[:3]:
        wanted = [int(colour[place : place + 2], 16) for place in (1, 3, 5)]
        assert (np.abs(pixels - wanted).sum(axis=1) < 12).sum() > 200


def test_an_svg_names_sides_and_axes_and_is_the_same_each_time(tmp_path):
    places = ["A-v0", "B-v0", "C-v0", "D-v0"]
    sides = [side("new", 0.9, environments=places), side("old", 0.5, seeds=1, environments=places)]
    first = plot_comparison(sides, places, tmp_path / "a.svg").read_text()
    assert first == plot_comparison(sides, places, tmp_path / "b.svg").read_text()
    xml.etree.ElementTree.fromstring(first)
    for text in ("new", "8 seeds", "old", "1 seed", "share of seeds above", "performance profile", "interquartile mean", "4 environments"):
        assert text in first
    assert all(f"sample efficiency, {place}" in first for place in places)
    assert "return of a seed, scaled to 0..1 on each environment" in first


def test_sides_without_learning_curves_are_drawn_without_them(tmp_path):
    sides = [side("plan", 1.0)._replace(curves={}), side("other", 1.0)._replace(curves={})]
    assert "sample efficiency" not in plot_comparison(sides, ["CartPole-v1"], tmp_path / "a.svg").read_text()


def test_curves_of_seeds_that_count_together_are_put_together_where_all_have_values(tmp_path):
    first = write_run(tmp_path / "a", [1.0, 2.0], curves=[[None, 1.0], [5.0, 1.0], [6.0, 2.0]])
    second = write_run(tmp_path / "b", [3.0], seed=1, curves=[[2.0], [3.0]])
    planned = write_run(tmp_path / "c", [3.0])
    curves = read_curves({"CartPole-v1": [first, second], "Acrobot-v1": [planned]})
    assert list(curves) == ["CartPole-v1"]
    assert [curve.values.shape for curve in curves["CartPole-v1"]] == [(3, 2), (2, 1)]
    drawn = side("both", 1.0, seeds=3)._replace(curves=curves)
    text = plot_comparison([drawn, side("other", 1.0)._replace(curves={})], ["CartPole-v1"], tmp_path / "a.svg").read_text()
    assert "sample efficiency, CartPole-v1" in text


def test_an_unknown_ending_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"a plot is written as \.png, \.svg, \.pdf; got 'x\.gif'"):
        plot_comparison([side("a", 1.0)], ["CartPole-v1"], tmp_path / "x.gif")
