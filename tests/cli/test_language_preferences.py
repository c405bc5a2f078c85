"""The verbs about preferences: what they answer, and mistakes in one line."""

import json

import pytest

from thorndike.cli.main import main

TASTE = (
    "def worth(prompt, candidate):\n    return float(candidate['text'].split()[1])\n\ndef broken(prompt, candidate):\n    return 1 / 0\n"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A store that a simulated crowd has filled, by commands alone."""
    made = tmp_path_factory.mktemp("preferences")
    worths = [(0.1 * each, 3.05 - 0.1 * each) for each in range(30)]
    rows = [{"prompt": f"p{each}", "candidates": [f"worth {worth}" for worth in pair]} for each, pair in enumerate(worths)]
    (made / "c.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (made / "guide.txt").write_text("Be fair.")
    (made / "taste.py").write_text(TASTE)
    db = ["--db", str(made / "p.db")]
    assert main(["language", "import", str(made / "c.jsonl"), *db, "--raters", "3", "--guidelines", str(made / "guide.txt")]) == 0
    assert main(["language", "label", *db, "--simulate", f"{made / 'taste.py'}:worth", "--repeats", "0.2"]) == 0
    return made


def answer(capsys, *words):
    capsys.readouterr()
    assert main(["language", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_what_the_crowd_said_is_told(folder, capsys):
    found = answer(capsys, "agree", "--db", folder / "p.db")
    assert found["items"] == found["done"] == 30 and found["pairs"] == found["shared_pairs"] == 30
    assert len(found["raters"]) == 12 and 0.3 < found["raw"] < 1 and found["raw_ci95"][0] <= found["raw"]
    assert main(["language", "agree", "--db", str(folder / "p.db")]) == 0
    assert "fair-1" in capsys.readouterr().out


def test_an_export_can_be_imported_and_nothing_is_written_over(folder, capsys, tmp_path):
    written = answer(capsys, "export", "--db", folder / "p.db", "--to", tmp_path / "out.jsonl", "--ties", "half")
    assert 0 < written["rows"] <= 32
    row = json.loads((tmp_path / "out.jsonl").read_text().splitlines()[0])
    assert {"prompt", "chosen", "rejected", "p_chosen", "n_labels", "pair_id", "raters"} <= row.keys() and row["n_labels"] == 3
    again = answer(capsys, "import", tmp_path / "out.jsonl", "--db", tmp_path / "other.db", "--rater", "crowd")
    assert again["format"] == "preference" and again["judgements"] == again["items"]
    assert main(["language", "export", "--db", str(folder / "p.db"), "--to", str(tmp_path / "out.jsonl")]) == 2
    assert "nothing is written over" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["agree", "--db", "p.db", "--project", "defualt"], "did you mean 'default'"),
        (["agree"], "required: --db"),
        (["agree", "--db", "no/such/x.db"], "no folder"),
        (["agree", "--db", "none.db"], "there is no store none.db"),
        (["label", "--db", "none.db"], "there is no store none.db"),
        (["export", "--db", "p.db", "--to", "x.parquet"], "ends in"),
        (["import", "nothing.jsonl", "--db", "p.db"], "cannot be read"),
        (["import", "c.jsonl", "--db", "p.db", "--share-to-three", "2"], "from 0 to 1"),
        (["import", "c.jsonl", "--db", "p.db", "--guidelines", "nothing"], "guidelines"),
        (["label", "--db", "p.db", "--media", "nothing"], "not a folder"),
        (["label", "--db", "p.db", "--simulate", "taste.worth"], "path/to/file.py:function"),
        (["label", "--db", "p.db", "--simulate", "taste.py:price"], "defines no function"),
        (["lable"], "did you mean 'label'"),
    ],
)
def test_mistakes_are_one_line(words, why, folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    capsys.readouterr()
    assert main(["language", *words]) == 2
    told = capsys.readouterr().err
    assert why in told and told.count("\n") == 1


def test_a_taste_that_fails_is_named_and_nothing_is_judged(folder, capsys, tmp_path):
    db = ["--db", str(tmp_path / "p.db")]
    assert main(["language", "import", str(folder / "c.jsonl"), *db]) == 0
    assert main(["language", "label", *db, "--simulate", f"{folder / 'taste.py'}:broken"]) == 2
    assert "ZeroDivisionError" in capsys.readouterr().err
    assert answer(capsys, "agree", *db)["judgements"] == 0
