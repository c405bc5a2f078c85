"""What a sweep tries: texts and values become lists and ranges, mistakes one line, draws lie in their ranges."""

import numpy as np
import pytest

from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.training.sweep_ranges import Search, Swept, chosen_search, listed_trials, over_texts, swept_settings

PPO = read_config_fields("ppo")


def swept(fixed=(), **over):
    return swept_settings(over, PPO, "ppo", dict.fromkeys(fixed))


@pytest.mark.parametrize(
    ("name", "text", "values"),
    [
        ("gamma", "0.9, 0.99", (0.9, 0.99)),
        ("n_epochs", "4,10", (4, 10)),
        ("activation", "relu,tanh", ("relu", "tanh")),
        ("normalize_advantage", "true,false", (True, False)),
        ("net_arch", "64,64;32", ((64, 64), (32,))),
        ("target_kl", "none,0.01", (None, 0.01)),
        ("learning_rate", "linear(1e-3,0);linear(3e-4,0)", ("linear(1e-3,0)", "linear(3e-4,0)")),
        ("learning_rate", "1e-3,linear(3e-4, 0)", (1e-3, "linear(3e-4, 0)")),
    ],
)
def test_a_list_is_read_as_values_of_the_setting(name, text, values):
    assert swept(**{name: text}) == (Swept(name, values),)


def test_values_given_in_python_are_taken_as_they_are_but_whole_numbers_become_rates():
    assert swept(gamma=[0, 0.5], net_arch=[[8], (8, 8)], n_epochs=[2, 3]) == (
        Swept("gamma", (0.0, 0.5)),
        Swept("net_arch", ((8,), (8, 8))),
        Swept("n_epochs", (2, 3)),
    )


def test_what_is_written_down_is_read_again():
    first = swept(learning_rate="log(1e-5,1e-2)", n_epochs="uniform(1,10)", net_arch="64,64;32", target_kl="none,0.01")
    assert swept(**{each.name: each.written() for each in first}) == first


@pytest.mark.parametrize(
    ("over", "words"),
    [
        ({}, "needs a setting to vary"),
        ({"learning_rat": "1,2"}, "did you mean 'learning_rate'"),
        ({"lr": "1,2"}, "did you mean 'learning_rate'"),
        ({"gamma": "0.9,1.5"}, "between 0 and 1"),
        ({"gamma": "0.9,often"}, "must be a number"),
        ({"gamma": "uniform(0.9,1.5)"}, "between 0 and 1"),
        ({"gamma": ""}, "has no value"),
        ({"gamma": "0.9"}, "has the one value 0.9"),
        ({"net_arch": "64,64"}, "with ';' between"),
        ({"gamma": "0.9,0.90"}, "has 0.9 twice"),
        ({"gamma": "uniform(0.99,0.9)"}, "below the second"),
        ({"gamma": "uniform(0.9)"}, "expected two numbers"),
        ({"gamma": "normal(0.9,0.1)"}, "a range is uniform"),
        ({"learning_rate": "log(0,1)"}, "begins above 0"),
        ({"activation": "uniform(1,2)"}, "a word, which has no range"),
        ({"normalize_advantage": "uniform(0,1)"}, "true or false, which has no range"),
        ({"net_arch": "uniform(1,2)"}, "which has no range"),
        ({"n_epochs": "uniform(1.5,3)"}, "must be a whole number"),
        ({"total_steps": "1,2"}, "given once, by --steps"),
        ({"seeds": "1,2"}, "given once, by --seeds"),
        ({"ent_coef": "0,0.1"}, "both fixed"),
    ],
)
def test_a_mistake_is_told_in_one_line(over, words):
    with pytest.raises(UserError, match=words) as caught:
        swept(fixed=("ent_coef",), **over)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("texts", "words"), [(["gamma"], "expected NAME=VALUES"), (["gamma=1,2", "gamma=3,4"], "given twice")])
def test_texts_without_a_name_or_twice_the_same_are_refused(texts, words):
    with pytest.raises(UserError, match=words):
        over_texts(texts)


def test_lists_make_a_grid_and_ranges_random_trials():
    lists, mixed = swept(gamma="0.9,0.99", n_epochs="1,2,3"), swept(gamma="0.9,0.99", learning_rate="log(1e-5,1e-2)")
    assert chosen_search(lists, "auto", None) == Search("grid", 6)
    assert chosen_search(lists, "auto", 4) == Search("random", 4)
    assert chosen_search(mixed, "auto", None) == Search("random", 20)
    assert chosen_search(mixed, "optuna", 7) == Search("optuna", 7)


@pytest.mark.parametrize(
    ("over", "search", "trials", "words"),
    [
        ({"gamma": "uniform(0,1)"}, "grid", None, "gamma is a range"),
        ({"gamma": "0.9,0.99"}, "grid", 2, "leave --trials out"),
        ({"gamma": "0.9,0.99"}, "auto", 2, "only 2 combinations"),
        ({"gamma": "uniform(0,1)"}, "auto", 20_000, "more than a sweep takes"),
    ],
)
def test_a_number_of_trials_without_a_use_is_refused(over, search, trials, words):
    with pytest.raises(UserError, match=words):
        chosen_search(swept(**over), search, trials)


def test_a_grid_has_every_combination_once():
    trials = listed_trials(swept(gamma="0.9,0.99", n_epochs="1,2,3"), Search("grid", 6), 0)
    assert trials[:2] == [{"gamma": 0.9, "n_epochs": 1}, {"gamma": 0.9, "n_epochs": 2}]
    assert len({tuple(trial.values()) for trial in trials}) == 6


def test_random_trials_of_lists_are_different_combinations():
    trials = listed_trials(swept(gamma="0.9,0.99", n_epochs="1,2,3"), Search("random", 5), 0)
    assert len({tuple(trial.values()) for trial in trials}) == 5


def test_draws_lie_in_their_ranges_on_their_scales_and_follow_from_the_seed():
    over = swept(learning_rate="log(1e-5,1e-1)", n_epochs="uniform(1,4)", batch_size="log(1,64)", gamma="uniform(0.5,1)")
    trials = listed_trials(over, Search("random", 4_000), 3)
    drawn = {name: np.array([trial[name] for trial in trials]) for name in trials[0]}
    assert np.median(drawn["learning_rate"]) == pytest.approx(1e-3, rel=0.2)
    assert [np.mean(drawn["n_epochs"] == n) for n in (1, 2, 3, 4)] == pytest.approx([0.25] * 4, abs=0.03)
    assert drawn["batch_size"].min() == 1 and drawn["batch_size"].max() == 64
    assert np.median(drawn["batch_size"]) == pytest.approx(8, abs=1)
    assert 0.5 <= drawn["gamma"].min() < drawn["gamma"].max() <= 1
    assert trials == listed_trials(over, Search("random", 4_000), 3) != listed_trials(over, Search("random", 4_000), 4)
