"""Damaged files of preferences: read whole, or refused in one line that names file and row; a store keeps what it had."""

import json
import random
from pathlib import Path

import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language.preference_files import read_comparisons
from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.formats import export_rows, import_records
from thorndike.language.preferences.records import read_records, write_records
from thorndike.language.preferences.store import Store
from thorndike.language.tokenizer import load_tokenizer

TOKENIZER = load_tokenizer(REFERENCE / "tokenizer")
ROWS = 5
SAID = [{"role": "user", "content": "the film"}]
MORE = pytest.mark.parametrize("files", [60, pytest.param(1_000, marks=pytest.mark.slow)])


def rows_of(draws: random.Random) -> list[dict]:
    words = ["good", "bad", "warm", "dull", "fine", "long"]
    return [
        {"prompt": f"film {number}: ", "chosen": f" {draws.choice(words[:3])} {number}", "rejected": f" {draws.choice(words[3:])}",
         "p_chosen": 0.9, "weight": 1.0}
        for number in range(ROWS)
    ]  # fmt: skip


# What is done to one row's JSON: no reader may take it for a preference.
DAMAGES = {
    "no chosen": lambda row: json.dumps({name: row[name] for name in row if name != "chosen"}),
    "no rejected": lambda row: json.dumps({name: row[name] for name in row if name != "rejected"}),
    "empty chosen": lambda row: json.dumps(row | {"chosen": ""}),
    "empty rejected": lambda row: json.dumps(row | {"rejected": ""}),
    "null": lambda row: json.dumps(row | {"chosen": None}),
    "a number": lambda row: json.dumps(row | {"rejected": 3}),
    "an object": lambda row: json.dumps(row | {"chosen": {"text": "x"}}),
    "a message without a role": lambda row: json.dumps(row | {"chosen": [{"content": "x"}]}),
    "no object": lambda row: json.dumps([row]),
    "cut off": lambda row: json.dumps(row)[:-3],
    "half a character": lambda row: json.dumps(row)[:-1] + ', "chosen": "\\ud800"}',
    "a name twice": lambda row: json.dumps(row)[:-1] + ', "chosen": "again"}',
    "another encoding": lambda row: json.dumps(row | {"chosen": " caf\u00e9"}, ensure_ascii=False).encode("latin-1"),
    "another width": lambda row: json.dumps(row).encode("utf-16-le"),
}


def written(path: Path, rows: list[dict], damaged: int, how: str) -> None:
    lines = [json.dumps(row).encode() for row in rows]
    made = DAMAGES[how](rows[damaged])
    lines[damaged] = made if isinstance(made, bytes) else made.encode()
    path.write_bytes(b"\n".join(lines) + b"\n")


@MORE
def test_a_damaged_row_is_named_and_nothing_of_the_file_is_taken(files, tmp_path):
    draws, path = random.Random(files), tmp_path / "prefs.jsonl"
    with Store(tmp_path / "x.db") as store:
        project, rater = store.project("p"), "file"
        before = rows_of(draws)
        write_records(tmp_path / "good.jsonl", before)
        import_records(store, project, read_records(tmp_path / "good.jsonl"), rater, Plan(share_to_more=0))
        kept = export_rows(store, project)
        for number in range(files):
            how, damaged = list(DAMAGES)[number % len(DAMAGES)], draws.randrange(ROWS)
            written(path, rows_of(draws), damaged, how)
            for read in (lambda: read_comparisons([path], TOKENIZER), lambda: read_records(path)):
                with pytest.raises(UserError) as refused:
                    read()
                said = str(refused.value)
                assert f"{path}, row {damaged + 1}" in said and "\n" not in said, (how, said)
            assert export_rows(store, project) == kept


def mutated(data: bytes, draws: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(draws.randint(1, 3)):
        place = draws.randrange(len(changed) or 1)
        match draws.randrange(4):
            case 0:
                changed[place : place + 1] = bytes([draws.randrange(256)])
            case 1:
                del changed[place : place + draws.randint(1, 12)]
            case 2:
                changed[place:place] = draws.choice([b"\x00", b'"', b"{", b"\n", b"\\ud800", b"\xc3", b",", b"NaN", b"null", b" "])
            case 3:
                changed = changed[: place + 1]
    return bytes(changed)


@MORE
@pytest.mark.parametrize("ending", [".jsonl", ".csv"])
def test_mutated_files_are_learnt_from_whole_kept_whole_or_refused(files, ending, tmp_path):
    draws, path = random.Random(f"{ending} {files}"), tmp_path / f"prefs{ending}"
    refusals = 0
    for number in range(files):
        write_records(path, [{name: row[name] for name in ("prompt", "chosen", "rejected")} for row in rows_of(draws)])
        path.write_bytes(mutated(path.read_bytes(), draws))
        try:
            records = read_records(path)
            comparisons = read_comparisons([path], TOKENIZER)
        except UserError as error:
            refusals += 1
            assert str(path) in str(error) and "\n" not in str(error)
            continue
        assert sum(len(each.pairs) for each in comparisons) == len(records.rows), "a pair for each row"
        if number % 10 == 0:
            came_back(records, tmp_path / f"{number}.db", tmp_path / f"{number}.jsonl")
    assert files // 5 < refusals < files


def came_back(records, where: Path, out: Path) -> None:
    """A file's preferences go through a store and its export as they were."""
    with Store(where) as store:
        project = store.project("p")
        import_records(store, project, records, "file", Plan(share_to_more=0))
        write_records(out, export_rows(store, project, "preference", "majority"))
    texts = {tuple(row[name] for name in ("prompt", "chosen", "rejected")) for row in records.rows}
    assert {tuple(row[name] for name in ("prompt", "chosen", "rejected")) for row in read_records(out).rows} == texts


def test_an_export_that_cannot_be_written_leaves_nothing(tmp_path):
    good = [{"prompt": "a", "chosen": "b", "rejected": "c"}]
    with pytest.raises(UserError) as refused:
        write_records(tmp_path / "x.jsonl", [*good, {"prompt": "a", "chosen": "\ud800", "rejected": "c"}])
    assert "x.jsonl" in str(refused.value) and "row 2" in str(refused.value) and not (tmp_path / "x.jsonl").exists()
    (tmp_path / "full").mkdir()
    with pytest.raises(UserError, match="full"):
        write_records(tmp_path / "full" / "no" / "x.jsonl", good)
