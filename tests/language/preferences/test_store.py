"""The store on both databases: what is acknowledged stays, once; nothing is overwritten."""

import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import select

from language.preferences.questions import question
from thorndike.errors import UserError
from thorndike.language.preferences import schema
from thorndike.language.preferences.assignment import Plan, next_assignments
from thorndike.language.preferences.judgements import Candidate, NewItem, Response
from thorndike.language.preferences.store import Store

PLAIN = Plan(gold=0, repeats=0)


@pytest.fixture
def store(new_store):
    with Store(new_store()) as opened:
        yield opened


def asked(store, project, name="anna", count=1, plan=PLAIN):
    return next_assignments(store, project, store.rater(name), count, plan)


def test_a_judgement_is_read_back_by_position_whatever_the_order_shown(store):
    project = store.project("p", "be kind")
    assert store.add_items(project, [question(each) for each in range(30)]) == 30
    assignments = asked(store, project, count=30)
    shown = {each.assignment: each for each in store.shown(assignments)}
    for each in assignments:
        # Say that "answer 0" is better, wherever it stands.
        side = "a" if str(shown[each].candidates[0]["text"]).startswith("answer 0") else "b"
        store.judge(Response(each, side, f"r{each}", strength=2, reason="short", milliseconds=1234))
    judged = store.judged(project)
    assert len(judged) == 30 and {each.ranks for each in judged} == {(0, 1)}
    assert {each.verdict for each in judged} == {"a", "b"} and {each.shown for each in judged} == {(0, 1), (1, 0)}
    assert {(each.strength, each.reason, each.milliseconds, each.rater) for each in judged} == {(2, "short", 1234, "anna")}
    assert store.guidelines(project) == "be kind" and store.progress(project) == (30, 30, 30)


def test_what_is_shown_does_not_tell_who_made_it(store):
    project = store.project("p")
    store.add_items(project, [question(0)])
    assert "model" not in repr(store.shown(asked(store, project)))


def test_a_repeated_request_is_the_same_judgement(store):
    project = store.project("p")
    store.add_items(project, [question(0)])
    (assignment,) = asked(store, project)
    first = store.judge(Response(assignment, "a", "one"))
    assert store.judge(Response(assignment, "a", "one")) == first
    with pytest.raises(UserError, match="judged already"):
        store.judge(Response(assignment, "b", "two"))
    assert store.history(assignment) == ["a"]


def test_undo_is_a_row_and_goes_back_as_far_as_one_likes(store):
    project, anna = store.project("p"), store.rater("anna")
    store.add_items(project, [question(each) for each in range(3)])
    assignments = asked(store, project, count=3)
    for each in assignments:
        store.judge(Response(each, "a", f"first {each}"))
    assert [store.undo(anna, f"undo {each}") for each in range(3)] == assignments[::-1]
    assert store.undo(anna, "undo 2") == assignments[0], "the same request again"
    assert store.undo(anna, "undo 3") is None
    assert store.judged(project) == [] and store.progress(project).done == 0
    assert asked(store, project, count=3) == assignments, "what was taken back comes again"
    store.judge(Response(assignments[0], "b", "again"))
    assert store.history(assignments[0]) == ["a", "undone", "b"] and len(store.judged(project)) == 1


def test_rankings_ties_and_what_does_not_fit(store):
    project = store.project("p")
    store.add_items(project, [question(0, candidates=4)])
    (assignment,) = asked(store, project)
    (shown,) = store.shown([assignment])
    places = [int(str(each["text"]).split()[1]) for each in shown.candidates]
    for verdict, ranks, why in [
        ("a", None, "two candidates"),
        ("ranking", [0, 1, 2], "4 whole numbers"),
        ("ranking", [0, 1, 2, -1], "4 whole numbers"),
        ("ranking", None, "belong to"),
        ("skip", [0, 1, 2, 3], "belong to"),
        ("best", None, "must be one of"),
        ("tie\0", None, "must be one of"),
    ]:
        with pytest.raises(UserError, match=why):
            store.judge(Response(assignment, verdict, "x", ranks))
    for wrong in ({"reason": "a\0b"}, {"reason": "\ud800"}, {"client": "\0"}, {"request": "\n"}, {"strength": 4}, {"milliseconds": -1}):
        with pytest.raises(UserError, match=r"must|no text"):
            store.judge(Response(assignment, "tie", "x")._replace(**wrong))
    with pytest.raises(UserError, match="no assignment"):
        store.judge(Response(10**6, "a", "x"))
    store.judge(Response(assignment, "ranking", "x", [5 * place // 2 for place in places]))
    assert store.judged(project)[0].ranks == (0, 1, 2, 3)


def test_a_skip_says_nothing_and_leaves_the_item_to_others(store):
    project = store.project("p")
    store.add_items(project, [question(0)])
    (assignment,) = asked(store, project)
    store.judge(Response(assignment, "skip", "x"))
    assert store.judged(project)[0].ranks is None and store.progress(project).done == 0
    assert asked(store, project) == [] and len(asked(store, project, "ben")) == 1


def test_adding_the_same_questions_again_adds_nothing_and_a_wrong_one_adds_none(store):
    project = store.project("p")
    items = [question(each) for each in range(5)]
    swapped = items[0]._replace(candidates=items[0].candidates[::-1])
    assert store.add_items(project, items) == 5 and store.add_items(project, [*items, swapped]) == 0
    same = NewItem({"text": "q"}, [Candidate({"text": "x"}), Candidate({"text": "x"})])
    unnamed = NewItem({"text": "q"}, [Candidate({"text": "x"}, "a\0"), Candidate({"text": "y"})])
    for wrong, why in [
        (question(9, candidates=1), "at least 2"),
        (question(9, best=2), "counted from 0"),
        (same, "with itself"),
        (unnamed, "printable"),
    ]:
        with pytest.raises(UserError, match=why):
            store.add_items(project, [question(77), wrong])
    assert len(store.questions(project)) == 5


@pytest.mark.parametrize("name", ["", " ", "x" * 101, "a\x1b[31m"])
def test_names_can_be_shown(store, name):
    with pytest.raises(UserError, match="printable"):
        store.rater(name)


def test_a_name_is_one_rater_however_many_sign_in_at_once(store):
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(lambda _: store.rater("anna  smith"), range(32)))) == 1


def test_the_same_request_from_many_sides_at_once_is_one_row(store):
    project = store.project("p")
    store.add_items(project, [question(0)])
    (assignment,) = asked(store, project)
    with ThreadPoolExecutor(8) as pool:
        numbers = set(pool.map(lambda _: store.judge(Response(assignment, "a", "one")), range(24)))
    assert len(numbers) == 1 and store.history(assignment) == ["a"]


def test_what_was_acknowledged_before_the_process_was_killed_is_there(new_store):
    where = new_store()
    with Store(where) as store:
        project = store.project("votes")
        store.add_items(project, [question(each) for each in range(600)])
    process = subprocess.Popen([sys.executable, RATING, where, "anna", "600"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    told = [process.stdout.readline() for _ in range(40)]
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read()
    acknowledged = {int(line) for line in ["".join(told), rest] for line in line.splitlines(keepends=True) if line.endswith("\n")}
    process.wait()
    with Store(where) as store:
        kept = judged_assignments(store)
        assert acknowledged <= set(kept) and len(kept) - len(acknowledged) <= 1
        assert max(Counter(kept).values()) == 1
        # And it goes on where it was.
        assert set(asked(store, project, count=4)).isdisjoint(kept)
        if "://" not in where:
            assert sqlite3.connect(where).execute("PRAGMA integrity_check").fetchone() == ("ok",)


@pytest.mark.parametrize("votes", [24, pytest.param(200, marks=pytest.mark.slow)])
def test_eight_raters_at_once_lose_and_double_nothing(new_store, votes):
    raters = 8
    where = new_store()
    with Store(where) as store:
        project = store.project("votes")
        store.add_items(project, [question(each, raters=2) for each in range(raters * votes * 5 // 8)])

        def rate(name):
            with Store(where) as own:
                rater, given = own.rater(name), []
                while len(given) < votes:
                    for assignment in next_assignments(own, project, rater, 4, PLAIN):
                        own.judge(Response(assignment, "ab"[assignment % 2], f"{name} {assignment}"))
                        given.append(assignment)
                return given

        with ThreadPoolExecutor(raters) as pool:
            given = [each for part in pool.map(rate, [f"rater {each}" for each in range(raters)]) for each in part]
        kept = judged_assignments(store)
        assert sorted(kept) == sorted(given) and len(set(kept)) == raters * votes
        judged = store.judged(project)
        assert max(Counter((each.item, each.rater) for each in judged).values()) == 1
        # No item has more raters than it wants.
        counts = Counter(Counter(each.item for each in judged).values())
        assert set(counts) <= {1, 2} and counts[2] > 0.7 * raters * votes / 2
        assert store.progress(project) == (raters * votes * 5 // 8, counts[2], raters * votes)


def test_what_is_no_store_is_refused_in_one_line(tmp_path, new_store):
    wrong = tmp_path / "text.db"
    wrong.write_text("this is not a database" * 100)
    for where, why in [(wrong, "not a database"), (tmp_path / "no" / "x.db", "no folder"), ("mysql://x/y", "SQLite or PostgreSQL")]:
        with pytest.raises(UserError, match=why) as error:
            Store(where)
        assert "\n" not in str(error.value)
    where = new_store()
    with Store(where) as store, store.database.writing() as connection:
        connection.execute(schema.store_version.update().values(version=99))
    with pytest.raises(UserError, match="version 99"):
        Store(where)


def judged_assignments(store):
    with store.database.reading() as connection:
        return list(connection.scalars(select(schema.judgement.c.assignment_id)))


RATING = str(Path(__file__).with_name("rating_process.py"))
