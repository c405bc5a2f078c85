"""Agreement against published worked examples, and what is told of raters whose faults are known."""

import math

import numpy as np
import pytest

from language.preferences.questions import question
from thorndike.language.preferences.agreement import agreement, cohen_kappa, fleiss_kappa, krippendorff_alpha
from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.judgements import Candidate, Judged, NewItem
from thorndike.language.preferences.raters import Rater, let_them_judge
from thorndike.language.preferences.store import Store

NAN = math.nan
# Krippendorff 2011, section C: four observers, twelve units.
KRIPPENDORFF = [
    [1, 2, 3, 3, 2, 1, 4, 1, 2, NAN, NAN, NAN],
    [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, NAN, 3],
    [NAN, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, NAN],
    [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, NAN],
]
# Fleiss's kappa as worked through in encyclopaedias: fourteen raters, ten subjects, five categories.
FLEISS = [
    [0, 0, 0, 0, 14], [0, 2, 6, 4, 2], [0, 0, 3, 5, 6], [0, 3, 9, 2, 0], [2, 2, 8, 1, 1],
    [7, 7, 0, 0, 0], [3, 2, 6, 3, 0], [2, 5, 3, 2, 2], [6, 5, 2, 1, 0], [0, 2, 2, 3, 7],
]  # fmt: skip


def test_alpha_of_the_published_example():
    assert krippendorff_alpha(KRIPPENDORFF, "nominal") == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha(KRIPPENDORFF, "ordinal") == pytest.approx(0.815, abs=5e-4)


def test_alpha_of_two_observers_in_the_published_example():
    # Krippendorff 2011, section A: ten units, binary.
    table = [[0, 1, 0, 0, 0, 0, 0, 0, 1, 0], [1, 1, 1, 0, 0, 1, 0, 0, 0, 0]]
    assert krippendorff_alpha(table, "nominal") == pytest.approx(0.095, abs=5e-4)


def test_kappas_of_the_published_examples():
    assert fleiss_kappa(FLEISS) == pytest.approx(0.210, abs=5e-4)
    # Cohen's: 20 both yes, 5 and 10 apart, 15 both no.
    first = [1] * 25 + [0] * 25
    second = [1] * 20 + [0] * 5 + [1] * 10 + [0] * 15
    assert cohen_kappa(first, second) == pytest.approx(0.4)


def test_what_nobody_shares_has_no_agreement():
    assert krippendorff_alpha([[1, NAN], [NAN, 0]], "nominal") is None
    assert krippendorff_alpha([[1, 1], [1, 1]], "ordinal") is None
    assert cohen_kappa([1, NAN], [NAN, 0]) is None and cohen_kappa([1, 1], [1, 1]) is None
    assert fleiss_kappa(np.zeros((0, 2))) is None and agreement([]).raw is None


def judged(item, rater, ranks, verdict="a", prompt=0, shown=(0, 1), repeated=False, best=None, candidates=(1, 2), strength=None):
    return Judged(item, prompt, candidates, rater, verdict, ranks, shown, repeated, best, strength, 2_000, "")


def test_raw_agreement_counts_pairs_of_raters():
    said = [judged(1, name, ranks) for name, ranks in [("a", (0, 1)), ("b", (0, 1)), ("c", (1, 0))]]
    said += [judged(2, name, (0, 1), candidates=(3, 4)) for name in "ab"] + [judged(3, "a", None, "skip", candidates=(5, 6))]
    found = agreement(said)
    assert (found.pairs, found.shared_pairs) == (2, 2) and found.raw == pytest.approx((1 / 3 + 1) / 2)
    low, high = found.raw_ci95
    assert low <= found.raw <= high
    by_name = {each.rater: each for each in found.raters}
    assert by_name["a"].with_others == (2, 3) and by_name["c"].with_others == (0, 2)
    assert by_name["a"].skipped == 1 and by_name["a"].median_seconds == 2


def test_gold_repeats_sides_and_cycles_of_a_rater():
    said = [
        judged(1, "a", (0, 1), "a", best=0),
        judged(2, "a", (0, 1), "a", best=1),
        judged(3, "a", (0, 0), "tie", best=0),
        judged(4, "a", (0, 1), "a"),
        judged(4, "a", (1, 0), "a", shown=(1, 0), repeated=True),
        # 11 > 12 > 13 > 11
        judged(5, "a", (0, 1), "b", prompt=7, candidates=(11, 12)),
        judged(6, "a", (0, 1), "a", prompt=7, candidates=(12, 13)),
        judged(7, "a", (1, 0), "a", prompt=7, candidates=(11, 13)),
    ]
    (report,) = agreement(said).raters
    assert report.gold == (1, 3) and report.consistency == (0, 1) and report.cycles == (1, 1) and report.left == (6, 7)
    transitive = [*said[:-1], said[-1]._replace(ranks=(0, 1))]
    assert agreement(transitive).raters[0].cycles == (0, 1)


def test_a_simulated_crowd_is_told_apart(tmp_path):
    with Store(tmp_path / "crowd.db") as store:
        project = store.project("p")
        gold = [NewItem({"text": f"gold {each}"}, [Candidate({"worth": 2.0}), Candidate({"worth": 0.0})], best=0) for each in range(40)]
        plain = [question(each, raters=4)._replace(candidates=worth(each)) for each in range(120)]
        store.add_items(project, [*gold, *plain])
        raters = [Rater("fair"), Rater("careful", 0.05, lapse=0), Rater("inverted", inverted=True), Rater("lefty", side_bias=4.0)]
        made = let_them_judge(store, project, raters, lambda prompt, content: float(content["worth"]), plan=Plan(gold=0.2, repeats=0.1))
        found = agreement(store.judged(project))
        by_name = {each.rater: each for each in found.raters}
        assert made == sum(each.judgements for each in found.raters) >= 480
        assert by_name["fair"].gold.value > 0.85 and by_name["inverted"].gold.value < 0.15
        assert by_name["careful"].consistency.value > 0.7 > by_name["lefty"].consistency.value
        assert by_name["lefty"].left.value > 0.9 and abs(by_name["fair"].left.value - 0.5) < 0.15
        assert by_name["fair"].with_others.value > by_name["inverted"].with_others.value
        assert found.fleiss_kappa is not None and found.alpha_ordinal is not None and found.cohen_kappa is not None


def worth(number):
    draws = np.random.default_rng(number).normal(size=2)
    return [Candidate({"worth": float(each)}) for each in draws]
