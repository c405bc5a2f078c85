"""Pictures of response curves: a panel a setting, of numbers, words and lists."""

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.plotting.sweep import plot_sweep
from thorndike.statistics.sweeps import Factor, effects_of

COLUMNS = {
    "learning_rate": [1e-5, 1e-4, 1e-3, 1e-2] * 3,
    "activation": ["relu", "tanh"] * 6,
    "net_arch": [(64, 64), (64, 64), (32,), (32,)] * 3,
    "normalize_advantage": [True, False] * 6,
}


def drawing(path):
    scores = np.random.default_rng(0).random((12, 2))
    effects = effects_of(scores, [Factor(name, tuple(column), name == "learning_rate") for name, column in COLUMNS.items()], "random")
    return plot_sweep(effects, COLUMNS, scores.mean(axis=1), 3, {"learning_rate"}, "ppo on CartPole-v1", path)


def test_a_panel_a_setting_with_its_verdict_and_its_words(tmp_path):
    text = drawing(tmp_path / "response.svg").read_text(encoding="utf-8")
    for word in (*COLUMNS, "12 trials", "ppo on CartPole-v1", "cannot tell", "relu", "64,64", "False"):
        assert f"<!-- {word}" in text or word in text, word


def test_a_picture_is_written_in_the_format_of_its_ending(tmp_path):
    assert drawing(tmp_path / "response.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UserError, match=r"\.png"):
        drawing(tmp_path / "response.bmp")
