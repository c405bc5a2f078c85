"""Who is asked what: how many raters an item gets, gold questions, repetitions, and what comes first."""

from collections import Counter

import pytest

from language.preferences.questions import question
from thorndike.errors import UserError
from thorndike.language.preferences import assignment
from thorndike.language.preferences.assignment import Plan, next_assignments, with_raters
from thorndike.language.preferences.judgements import Response
from thorndike.language.preferences.store import Store


@pytest.fixture
def store(tmp_path):
    with Store(tmp_path / "x.db") as opened:
        yield opened


def judge_all(store, project, name, count, plan):
    rater = store.rater(name)
    for _ in range(count):
        for each in next_assignments(store, project, rater, 1, plan):
            store.judge(Response(each, "a", f"{name} {each}"))


def test_about_15_percent_of_the_items_go_to_three_raters():
    counts = Counter(each.raters for each in with_raters((question(each) for each in range(2_000)), Plan()))
    assert set(counts) == {1, 3} and 0.12 < counts[3] / 2_000 < 0.18


def test_gold_and_repeats_have_their_shares_and_repeats_come_late_with_sides_swapped(store):
    project, plan = store.project("p"), Plan(gold=0.2, repeats=0.1)
    store.add_items(project, [question(each) for each in range(400)] + [question(1_000 + each, best=0) for each in range(200)])
    judge_all(store, project, "anna", 300, plan)
    judged = store.judged(project)
    assert 0.14 < sum(each.best is not None for each in judged) / 300 < 0.26 and 0.06 < sum(each.repeated for each in judged) / 300 < 0.14
    places = {each.item: place for place, each in enumerate(judged) if not each.repeated}
    for place, each in enumerate(judged):
        if each.repeated:
            assert place - places[each.item] > 20 and each.shown == judged[places[each.item]].shown[::-1] and each.best is None
    assert max(Counter((each.item, each.repeated) for each in judged).values()) == 1
    first = sum(each.shown[0] == 0 for each in judged)
    assert 0.4 < first / 300 < 0.6, "sides are drawn"


def test_a_rater_who_has_seen_everything_gets_nothing(store):
    project = store.project("p")
    store.add_items(project, [question(each, raters=2) for each in range(5)])
    for name in ("anna", "ben", "cleo"):
        judge_all(store, project, name, 9, Plan(repeats=0))
    assert Counter(each.rater for each in store.judged(project)) == {"anna": 5, "ben": 5}
    assert next_assignments(store, project, store.rater("cleo"), 4) == []


def test_an_item_is_held_for_whom_it_was_shown_to_but_not_for_ever(store, monkeypatch):
    project = store.project("p")
    store.add_items(project, [question(0)])
    anna, ben = store.rater("anna"), store.rater("ben")
    (held,) = next_assignments(store, project, anna, 4)
    assert next_assignments(store, project, ben, 4) == [] and next_assignments(store, project, anna, 4) == [held]
    monkeypatch.setattr(assignment, "_FRESH_S", 0.0)
    assert len(next_assignments(store, project, ben, 4)) == 1


def test_where_an_ensemble_disagrees_is_asked_first(store):
    project = store.project("p")
    store.add_items(project, [question(each) for each in range(6)])
    numbers = list(store.questions(project))
    store.set_priorities({numbers[4]: 0.9, numbers[2]: 0.5})
    asked = store.shown(next_assignments(store, project, store.rater("anna"), 3, Plan(gold=0, repeats=0)))
    assert [each.prompt["text"] for each in asked] == ["question 4", "question 2", "question 0"]


def test_projects_are_apart(store):
    one, two = store.project("one"), store.project("two")
    store.add_items(one, [question(0)])
    assert next_assignments(store, two, store.rater("anna"), 4) == []
    assert store.projects() == {"one": one, "two": two}


@pytest.mark.parametrize("wrong", [{"raters": 0}, {"raters": 5}, {"gold": 1.5}, {"gold": 0.6, "repeats": 0.6}, {"repeat_after": 0}])
def test_plans_that_cannot_be_are_refused(wrong):
    with pytest.raises(UserError, match=r"must|shares"):
        Plan(**wrong)
