"""Trials come all at once, or from Optuna, which proposes the same for the same scores."""

import math

import pytest

from thorndike.errors import UserError
from thorndike.training import sweep_search
from thorndike.training.sweep_ranges import Search, Swept
from thorndike.training.sweep_search import check_search, proposals, round_size

SWEPT = (
    Swept("learning_rate", (), 1e-5, 1e-1, "log"),
    Swept("n_epochs", (), 1, 9, "uniform", whole=True),
    Swept("net_arch", ((8,), (64, 64))),
)


def played(search, at_once=4, fail=()):
    """All trials of a search whose score is best where the learning rate is 1e-3."""
    source, trials = proposals(SWEPT, search, 0, at_once), []
    asked = next(source)
    while asked is not None:
        trials += asked
        scores = [math.nan if len(trials) in fail else -abs(math.log10(each["learning_rate"]) + 3) for each in asked]
        try:
            asked = source.send(scores)
        except StopIteration:
            asked = None
    return trials


def test_a_random_search_proposes_all_its_trials_at_once():
    source = proposals(SWEPT, Search("random", 6), 0, 2)
    assert len(next(source)) == 6
    with pytest.raises(StopIteration):
        source.send([0.0] * 6)


def test_optuna_stays_in_the_ranges_and_comes_to_the_optimum():
    pytest.importorskip("optuna")
    trials = played(Search("optuna", 40))
    assert len(trials) == 40
    assert all(1e-5 <= each["learning_rate"] <= 1e-1 and each["n_epochs"] in range(1, 10) for each in trials)
    assert {each["net_arch"] for each in trials} == {(8,), (64, 64)}
    distance = [abs(math.log10(each["learning_rate"]) + 3) for each in trials]
    assert sum(distance[-15:]) / 15 < sum(distance[:10]) / 10


def test_optuna_proposes_the_same_for_the_same_scores_failures_included():
    pytest.importorskip("optuna")
    assert played(Search("optuna", 16), fail=(4, 8)) == played(Search("optuna", 16), fail=(4, 8))


def test_rounds_of_optuna_are_small_enough_to_learn_from():
    assert round_size(Search("optuna", 40), 16) == 5
    assert round_size(Search("optuna", 40), 3) == 3
    assert round_size(Search("optuna", 4), 16) == 1


def test_without_optuna_one_line_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(sweep_search.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'thorndike\[sweep\]'"):
        check_search(Search("optuna", 5))
    check_search(Search("random", 5))
