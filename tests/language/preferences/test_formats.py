"""Files of preferences in TRL's formats: what is read is kept, what is wrong is named by file and row, what is written is read again."""

import json
import random

import pytest

from language.preferences.questions import question
from thorndike.errors import UserError
from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.formats import EXPORTS, export_rows, import_records
from thorndike.language.preferences.raters import Rater, let_them_judge
from thorndike.language.preferences.records import check_records, read_records, with_explicit_prompt, write_records
from thorndike.language.preferences.store import Store


def said(role, content):
    return {"role": role, "content": content}


ASK, GOOD, BAD = said("user", "What is 2 + 2?"), said("assistant", "4"), said("assistant", "22")
EXAMPLES = {
    ("language_modeling", False): {"text": "The sky is blue."},
    ("language_modeling", True): {"messages": [ASK, GOOD]},
    ("prompt_only", False): {"prompt": "The sky is"},
    ("prompt_only", True): {"prompt": [ASK]},
    ("prompt_completion", False): {"prompt": "The sky is", "completion": " blue."},
    ("prompt_completion", True): {"prompt": [ASK], "completion": [GOOD]},
    ("preference", False): {"prompt": "The sky is", "chosen": " blue.", "rejected": " green."},
    ("preference", True): {"prompt": [ASK], "chosen": [GOOD], "rejected": [BAD]},
    ("unpaired_preference", False): {"prompt": "The sky is", "completion": " blue.", "label": True},
    ("unpaired_preference", True): {"prompt": [ASK], "completion": [GOOD], "label": False},
    ("candidates", False): {"prompt": "The sky is", "candidates": [" blue.", " green.", " up."]},
}


@pytest.mark.parametrize("ending", [".jsonl", ".json", ".csv"])
@pytest.mark.parametrize("kind", EXAMPLES)
def test_every_format_is_told_and_comes_back_as_it_was(kind, ending, tmp_path):
    rows = [EXAMPLES[kind] | {"note": f'a "quoted", note {each}\nof two lines: é', "n": [{"x": 1.5}]} for each in range(3)]
    assert write_records(tmp_path / f"x{ending}", rows) == 3
    read = read_records(tmp_path / f"x{ending}")
    assert (read.format, read.conversational) == kind and read.rows == rows


def test_an_implicit_prompt_is_what_both_answers_begin_with():
    row = {"chosen": "The sky is blue.", "rejected": "The sky is green.", "id": 7}
    assert with_explicit_prompt(row) == {"prompt": "The sky is", "chosen": " blue.", "rejected": " green.", "id": 7}
    talk = {"chosen": [ASK, GOOD], "rejected": [ASK, BAD]}
    assert with_explicit_prompt(talk) == {"prompt": [ASK], "chosen": [GOOD], "rejected": [BAD]}
    assert with_explicit_prompt({"chosen": "a", "rejected": "b"})["prompt"] == ""
    one_begins_the_other = with_explicit_prompt({"chosen": "yes", "rejected": "yes!"})
    assert one_begins_the_other == {"prompt": "ye", "chosen": "s", "rejected": "s!"}
    assert with_explicit_prompt(EXAMPLES["preference", False]) == EXAMPLES["preference", False]


GOOD_ROW = EXAMPLES["preference", False]
WRONG = {
    "no JSON": ('{"prompt": ', "row 2: no JSON"),
    "no object": ("[1, 2]", "row 2: expected an object"),
    "an unknown column": ('{"question": "a"}', "row 2 has the columns 'question'"),
    "an answer missing": ('{"prompt": "a", "chosen": null, "rejected": "b"}', "row 2"),
    "an empty answer": ('{"prompt": "a", "chosen": " ", "rejected": "b"}', "row 2: 'chosen' is empty"),
    "a number for an answer": ('{"prompt": "a", "chosen": 3, "rejected": "b"}', "row 2: 'chosen' is 3"),
    "answers that are the same": ('{"prompt": "a", "chosen": "b", "rejected": "b"}', "row 2: .* the same"),
    "a name twice": ('{"prompt": "a", "prompt": "b", "chosen": "c", "rejected": "d"}', "row 2: .* twice"),
    "half a character": ('{"prompt": "a", "chosen": "\\ud83d", "rejected": "d"}', "row 2 holds half a character"),
    "no number": ('{"prompt": "a", "chosen": "c", "rejected": "d", "weight": NaN}', "row 2: .* NaN"),
    "mixed forms": ('{"prompt": "a", "chosen": [{"role": "user", "content": "x"}], "rejected": "d"}', "row 2 mixes forms"),
    "a wrong message": ('{"prompt": "a", "chosen": [{"role": "user"}], "rejected": "d"}', "row 2: 'chosen', message 1"),
    "another format": ('{"prompt": "a", "completion": "b"}', "row 2 is standard prompt completion, but the rows before are standard pref"),
    "deep nesting": ('{"prompt": ' + "[" * 100_000, "row 2: nested too deeply"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named_by_file_and_row(name, tmp_path):
    line, why = WRONG[name]
    (tmp_path / "x.jsonl").write_text(f"{json.dumps(GOOD_ROW)}\n{line}\n{json.dumps(GOOD_ROW)}\n")
    with pytest.raises(UserError, match=rf"x\.jsonl, {why}") as error:
        read_records(tmp_path / "x.jsonl")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("x.jsonl", b'{"text": "a"}\n{"text": "\xff"}', "row 2: not UTF-8"),
        ("x.csv", b"text,n\na,1\n\xff,2\n", "row 3: not UTF-8"),
        ("x.csv", b"text,n\na,1\nb\n", "row 2: it has not as many cells"),
        ("x.csv", b"text,text\na,1\n", "names a column twice"),
        ("x.csv", b'text,n\n"a,1\n', "row 1: "),
        ("x.csv", b"prompt,completion,label\na,b,perhaps\n", "'label' is 'perhaps'"),
        ("x.json", b'{"text": "a"}', "expected a list"),
        ("x.jsonl", b"\n\n", "no rows"),
        ("x.txt", b"a", "ends in"),
    ],
)
def test_what_is_wrong_with_a_file(name, content, why, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=why):
        read_records(tmp_path / name)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        read_records(tmp_path / "x.jsonl")


@pytest.mark.parametrize("ending", [".jsonl", ".json", ".csv"])
@pytest.mark.parametrize("files", [50, pytest.param(1_000, marks=pytest.mark.slow)])
def test_mutated_files_are_read_whole_or_refused_in_one_line(files, ending, tmp_path):
    draws, path = random.Random(f"{ending} {files}"), tmp_path / f"x{ending}"
    examples = [[row, row | {"n": 2}, row] for row in EXAMPLES.values()]
    refused = 0
    for each in range(files):
        write_records(path, examples[each % len(examples)])
        data = bytearray(path.read_bytes())
        for _ in range(draws.randint(1, 4)):
            place = draws.randrange(len(data) or 1)
            match draws.randrange(4):
                case 0:
                    data[place : place + 1] = bytes([draws.randrange(256)])
                case 1:
                    del data[place : place + draws.randint(1, 20)]
                case 2:
                    data[place:place] = draws.choice([b"\x00", b'"', b"{", b"[", b"\n", b"\\ud800", b"\xc3", b",", b"1e999", b"null"])
                case 3:
                    data = data[: place + 1]
        path.write_bytes(bytes(data))
        try:
            records = read_records(path)
        except UserError as error:
            refused += 1
            assert "\n" not in str(error) and str(path) in str(error)
        else:
            # What was read can be kept: it is written and read again as it is.
            write_records(path, records.rows)
            assert read_records(path).rows == records.rows
    assert refused > files // 4


def test_preferences_go_into_a_store_and_come_out_as_they_were(tmp_path):
    rows = [{"prompt": f"p{each % 7}", "chosen": f" good {each}", "rejected": f" bad {each}", "source": "s"} for each in range(40)]
    with Store(tmp_path / "x.db") as store:
        project = store.project("p")
        records = check_records(rows, "rows")
        assert import_records(store, project, records, "file", Plan(share_to_more=0)) == (40, 40, 0)
        assert import_records(store, project, records, "file", Plan(share_to_more=0)) == (0, 0, 0), "again adds nothing"
        out = export_rows(store, project)
        texts = [{name: row[name] for name in ("prompt", "chosen", "rejected")} for row in out]
        assert texts == [{name: row[name] for name in ("prompt", "chosen", "rejected")} for row in rows]
        assert {row["n_labels"] for row in out} == {1} and len({row["prompt_id"] for row in out}) == 7
        write_records(tmp_path / "out.jsonl", out)
        other = store.project("other")
        again = import_records(store, other, read_records(tmp_path / "out.jsonl"), "file", Plan(share_to_more=0))
        assert again == (40, 40, 0) and len(export_rows(store, other)) == 40


def test_a_wrong_row_adds_nothing(tmp_path):
    with Store(tmp_path / "x.db") as store:
        project = store.project("p")
        rows = [{"prompt": "p", "candidates": ["a", "b"]}, {"prompt": "q", "candidates": ["a", "b"], "best": 5}]
        with pytest.raises(UserError, match="rows, row 2: 'best'"):
            import_records(store, project, check_records(rows, "rows"), "file", Plan())
        with pytest.raises(UserError, match="rows, row 1: its prompt has one completion"):
            import_records(store, project, check_records([{"prompt": "p", "completion": "a"}], "rows"), "file", Plan())
        with pytest.raises(UserError, match="nothing to compare"):
            import_records(store, project, check_records([{"prompt": "p"}], "rows"), "file", Plan())
        assert store.questions(project) == {}


def test_completions_of_a_prompt_become_one_item_and_clips_are_items_too(tmp_path):
    with Store(tmp_path / "x.db") as store:
        project = store.project("p")
        rows = [{"prompt": f"p{each % 2}", "completion": f"c{each}", "model": f"m{each}"} for each in range(6)]
        assert import_records(store, project, check_records(rows, "rows"), "file", Plan()) == (2, 0, 0)
        clips = [
            {
                "prompt": {"text": "Which one walks?"},
                "candidates": [{"media": "a.mp4"}, {"media": "b.mp4"}],
                "models": ["x", "y"],
                "best": 1,
            }
        ]
        assert import_records(store, project, check_records(clips, "rows"), "file", Plan()) == (1, 0, 0)
        assert [(len(each.candidates), each.best) for each in store.questions(project).values()] == [(3, None), (3, None), (2, 1)]


def test_samples_that_are_the_same_are_compared_once_or_left_out(tmp_path):
    with Store(tmp_path / "x.db") as store:
        project = store.project("p")
        rows = [{"prompt": "p", "completions": ["a", "a", "b"], "best": 2}, {"prompt": "q", "completions": ["a", "a"]}]
        assert import_records(store, project, check_records(rows, "rows"), "file", Plan()) == (1, 0, 1)
        assert [(len(each.candidates), each.best) for each in store.questions(project).values()] == [(2, 1)]


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Rankings of three, ties, skips and conversations."""
    store = Store(tmp_path_factory.mktemp("store") / "x.db")
    project = store.project("p")
    store.add_items(project, [question(each, candidates=3, raters=3) for each in range(6)])
    store.add_items(project, [question(100 + each, raters=3) for each in range(12)])
    talks = [{"prompt": [ASK | {"content": f"{each}?"}], "candidates": [[GOOD], f"{each * 22}"]} for each in range(1, 9)]
    import_records(store, project, check_records(talks, "rows"), "file", Plan(raters=3))
    raters = [Rater("a", ties=1.0), Rater("b"), Rater("c", ties=2.5)]
    let_them_judge(store, project, raters, lambda prompt, content: hash_of(str(content)), plan=Plan(repeats=0.2, repeat_after=3))
    yield store, project
    store.close()


def hash_of(text):
    return random.Random(text).gauss(0, 1)


@pytest.mark.parametrize("what", EXPORTS)
def test_every_export_is_read_again(what, judged, tmp_path):
    store, project = judged
    rows = export_rows(store, project, what)
    assert rows
    standard = [row for row in rows if isinstance(row.get("prompt", row.get("chosen")), str)]
    conversational = [row for row in rows if row not in standard]
    for number, part in enumerate([standard, conversational]):
        write_records(tmp_path / f"{number}.jsonl", part)
        read = read_records(tmp_path / f"{number}.jsonl")
        assert read.rows == part and read.conversational == bool(number)
        expected = {"preference": "preference", "implicit": "preference", "unpaired": "unpaired_preference", "judgements": "candidates"}
        assert read.format == expected.get(what, what)


def test_a_ranking_gives_all_its_pairs_and_ties_go_both_ways_if_asked(judged):
    store, project = judged
    dropped, half = export_rows(store, project), export_rows(store, project, ties="half")
    ties = [row for row in half if row["tie"]]
    assert ties and len(half) == len(dropped) + len(ties) and len({row["pair_id"] for row in half}) == 6 * 3 + 12 + 8
    assert len(ties) == 2 * len({row["pair_id"] for row in ties}) and {row["weight"] for row in ties} == {0.5}
    for row in dropped:
        assert row["n_labels"] == 3 == len(row["raters"]) and 0.5 < row["p_chosen"] <= 1 and 0 <= row["n_agree"] <= 3
    assert {row["p_chosen"] for row in export_rows(store, project, method="majority")} == {1.0}


def test_unknown_exports_are_refused(judged):
    store, project = judged
    for wrong in ({"what": "parquet"}, {"ties": "both"}, {"method": "best"}):
        with pytest.raises(UserError, match=r"there (is|are)|can be"):
            export_rows(store, project, **wrong)
