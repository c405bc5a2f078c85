"""TRL's formats, packing, and malformed files: one line that names file and row."""

import json
import random
from pathlib import Path

import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language.data import TokenRow, as_tokens, format_of, prompt_tokens, read_rows, tokenize
from thorndike.language.packing import batch_at, concatenated, packed
from thorndike.language.tokenizer import load_tokenizer

TOKENIZER = load_tokenizer(REFERENCE / "tokenizer")
USER, ANSWER = {"role": "user", "content": "why"}, {"role": "assistant", "content": "so"}
ROWS = {
    "language_modelling": {"text": "the film"},
    "prompt_completion": {"prompt": "the", "completion": " film"},
    "preference": {"prompt": "the", "chosen": " film", "rejected": " bad"},
    "judged": {"prompt": "the", "completion": " film", "label": True},
    "prompt": {"prompt": "the"},
}


def write(folder: Path, *rows: object, name: str = "data.jsonl") -> Path:
    path = folder / name
    path.write_text("\n".join(json.dumps(row) for row in rows))
    return path


def test_formats_are_recognised_by_their_columns(tmp_path: Path) -> None:
    rows = read_rows(write(tmp_path, *ROWS.values(), {"messages": [USER, ANSWER]}, {"chosen": [USER, ANSWER], "rejected": [USER, ANSWER]}))
    assert [format_of(row) for row in rows] == [*ROWS, "language_modelling", "preference"]


@pytest.mark.parametrize("name", ["data.jsonl", "data.json", "data.csv"])
def test_files_of_each_kind_hold_the_same_rows(name: str, tmp_path: Path) -> None:
    texts = {"prompt": 'a "quoted", prompt\n', "completion": "é ✓"}
    path = tmp_path / name
    if name.endswith("csv"):
        path.write_text('prompt,completion\n"a ""quoted"", prompt\n","é ✓"\n', encoding="utf-8")
    else:
        path.write_text(json.dumps(texts if name.endswith("l") else [texts]))
    (row,) = read_rows(path)
    assert row.content == texts and row.where == f"{path}, row 1"


def test_texts_end_and_only_completions_are_learnt(tmp_path: Path) -> None:
    text, pair = read_rows(write(tmp_path, ROWS["language_modelling"], ROWS["prompt_completion"]))
    whole = as_tokens(text, TOKENIZER)
    assert whole.tokens == [*TOKENIZER.encode("the film"), TOKENIZER.eos_id] and all(whole.learn)
    found = as_tokens(pair, TOKENIZER)
    prompt = prompt_tokens("the", TOKENIZER)
    assert found.tokens == [*prompt, *TOKENIZER.encode(" film", special=False), TOKENIZER.eos_id]
    assert found.learn == [False] * len(prompt) + [True] * (len(found.tokens) - len(prompt))


def test_of_a_conversation_the_assistants_turns_are_learnt(tmp_path: Path) -> None:
    messages = [USER, ANSWER, USER, {"role": "assistant", "content": "no"}]
    whole, last = read_rows(write(tmp_path, {"messages": messages}, {"prompt": messages[:3], "completion": messages[3:]}))
    turns, pair = tokenize([whole, last], TOKENIZER)
    assert turns.tokens == TOKENIZER.encode_chat(messages, prompt=False)
    learnt = TOKENIZER.decode([token for token, learn in zip(turns.tokens, turns.learn, strict=True) if learn], special=True)
    assert learnt == "so<|im_end|>\nno<|im_end|>\n"
    assert (
        TOKENIZER.decode([token for token, learn in zip(pair.tokens, pair.learn, strict=True) if learn], special=True) == "no<|im_end|>\n"
    )


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ({"txt": "a"}, "columns"),
        ({"text": ""}, "text is empty"),
        ({"text": 5}, "text is 5"),
        ({"prompt": "a", "completion": ""}, "completion is empty"),
        ({"prompt": "a", "completion": [ANSWER]}, "both be texts"),
        ({"messages": [{"role": "user"}]}, "role and content"),
        ({"messages": [USER]}, "no turn of the assistant"),
        ({"messages": "text"}, "list of messages"),
        ({"text": [USER]}, "column messages"),
        ({"text": "\ud800"}, "half a character"),
        ({"prompt": "a"}, "nothing to imitate"),
        ([1], "expected an object"),
    ],
)
def test_what_is_wrong_with_a_row_is_told_with_file_and_row(row: object, words: str, tmp_path: Path) -> None:
    path = write(tmp_path, {"text": "good"}, row)
    with pytest.raises(UserError, match=words) as refused:
        tokenize(read_rows(path), TOKENIZER)
    assert f"{path}, row 2" in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.jsonl", b'{"text": "a"}\n{"text": "\xff"}', "row 2: not UTF-8"),
        ("a.jsonl", b'{"text": "a"}\n{"text": ', "row 2: no JSON"),
        ("a.jsonl", b"", "no rows"),
        ("a.json", b'{"text": "a"}', "list of objects"),
        ("a.csv", b"text\n\xff", "row 2: not UTF-8"),
        ("a.csv", b"text,label\na", "as many cells"),
        ("a.parquet", b"nothing", "parquet"),
        ("a.xml", b"", "ends in"),
    ],
)
def test_files_that_cannot_be_read_are_one_line(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=words) as refused:
        read_rows(tmp_path / name)
    assert str(tmp_path / name) in str(refused.value)


def test_a_thousand_mutated_files_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    rng, good = random.Random(0), "\n".join(json.dumps(row) for row in [*ROWS.values(), {"messages": [USER, ANSWER]}]).encode()
    refusals = 0
    for number in range(1000):
        data = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            place = rng.randrange(len(data))
            data[place : place + rng.randint(0, 3)] = bytes(rng.randrange(256) for _ in range(rng.randint(0, 3)))
        path = tmp_path / f"data{number % 4}{('.jsonl', '.csv', '.json')[number % 3]}"
        path.write_bytes(data)
        try:
            tokenize(read_rows(path), TOKENIZER)
        except UserError as error:
            refusals += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refusals > 500


def token_rows() -> list[TokenRow]:
    rng = np.random.default_rng(0)
    return [TokenRow([int(token) for token in rng.integers(3, 90, length)], [True] * length) for length in (5, 16, 3, 9, 40, 2, 7, 1)]


def test_packed_rows_hold_every_text_once_and_apart() -> None:
    rows = packed(token_rows(), 16, 0)
    found = []
    for tokens, segments, learn in zip(*rows, strict=True):
        assert not learn[segments == 0].any() and (tokens[segments == 0] == 0).all()
        found += [tuple(tokens[segments == number].tolist()) for number in range(1, segments.max() + 1)]
    pieces = [tuple(text.tokens[begin : begin + 16]) for text in token_rows() for begin in range(0, len(text.tokens), 16)]
    assert sorted(found) == sorted(piece for piece in pieces if len(piece) > 1)
    assert rows.tokens.shape[0] == 6 and (rows.segments > 0).mean() > 0.85
    with pytest.raises(UserError, match="nothing to learn"):
        packed([TokenRow([1, 2], [True, False])], 16, 0)


def test_concatenated_rows_are_all_texts_one_after_the_other() -> None:
    rows = concatenated(token_rows(), 16, 0)
    joined = [token for text in token_rows() for token in text.tokens]
    np.testing.assert_array_equal(rows.tokens.ravel()[: len(joined)], joined)
    assert rows.tokens.shape[0] == -(-len(joined) // 16) and (rows.segments.ravel()[: len(joined)] > 0).all()


def test_batches_visit_every_row_once_an_epoch_in_an_order_that_follows_from_the_seed() -> None:
    rows = packed(token_rows(), 16, 0)
    seen = np.concatenate([np.asarray(batch_at(rows, 2, step, seed=1).tokens) for step in range(3)])
    assert sorted(map(tuple, seen)) == sorted(map(tuple, rows.tokens))
    again = np.asarray(batch_at(rows, 2, 2, seed=1).tokens)
    np.testing.assert_array_equal(again, seen[4:])
    orders = {tuple(np.asarray(batch_at(rows, 6, step, seed).tokens[:, 0])) for step in range(2) for seed in range(2)}
    assert len(orders) == 4
