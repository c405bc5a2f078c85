"""Tokenizers and chat templates give what transformers gives; padding is never the end."""

import json
from pathlib import Path

import pytest
from tokenizers import Tokenizer as Inner
from tokenizers import models

from language.make_reference import CHATS, MESSAGES, REFERENCE
from thorndike.errors import UserError
from thorndike.language.chat_template import render
from thorndike.language.tokenizer import load_tokenizer, new_tokenizer, save_tokenizer

FOLDER = REFERENCE / "tokenizer"
EXPECTED = json.loads((FOLDER / "expected.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", CHATS)
@pytest.mark.parametrize("prompt", [False, True])
def test_chats_are_those_of_apply_chat_template(name: str, prompt: bool) -> None:
    tokenizer = load_tokenizer(FOLDER)
    wanted = EXPECTED["chats"][f"{name}_prompt" if prompt else name]
    assert render(CHATS[name], MESSAGES, tokenizer.special_texts, prompt) == wanted


def test_texts_become_the_tokens_of_transformers_and_texts_again() -> None:
    tokenizer = load_tokenizer(FOLDER)
    assert tokenizer.encode_many(EXPECTED["texts"]) == EXPECTED["ids"] == [tokenizer.encode(text) for text in EXPECTED["texts"]]
    assert [tokenizer.decode(ids) for ids in EXPECTED["ids"]] == EXPECTED["decoded"]
    assert tokenizer.decode(EXPECTED["ids"][2], special=True) == "<s>a</s>b"


def test_a_conversation_ends_where_the_model_is_to_answer() -> None:
    tokenizer = load_tokenizer(FOLDER)
    assert tokenizer.chat(MESSAGES).endswith("<|im_start|>assistant\n")
    assert tokenizer.encode_chat(MESSAGES) == tokenizer.encode(tokenizer.chat(MESSAGES), special=False)


@pytest.mark.parametrize(
    ("template", "messages", "words"),
    [
        (CHATS["instruct"], MESSAGES[1:2] * 2, "user and assistant must take turns"),
        ("{% for m in messages %}", MESSAGES, "chat template"),
        ("{{ messages.append(1) }}", MESSAGES, "chat template"),
        ("{{ ''.__class__.__mro__ }}", MESSAGES, "chat template"),
        ("{% set n = namespace(__class__=1) %}", MESSAGES, "may not set"),
        ("{{ messages[0]['content'] + 1 }}", MESSAGES, "chat template"),
    ],
)
def test_templates_that_refuse_or_reach_too_far_are_one_line(template: str, messages: list, words: str) -> None:
    with pytest.raises(UserError, match=words):
        render(template, messages, {"bos_token": "", "eos_token": ""}, True)


def test_padding_is_never_the_end(tmp_path: Path) -> None:
    for name, text in {"pad_token": "</s>", "eos_token": "</s>"}.items():
        settings = json.loads((FOLDER / "tokenizer_config.json").read_text())
        for path in FOLDER.iterdir():
            (tmp_path / path.name).write_bytes(path.read_bytes())
        (tmp_path / "tokenizer_config.json").write_text(json.dumps(settings | {name: text}))
        tokenizer = load_tokenizer(tmp_path)
        assert tokenizer.eos_id == 2 and tokenizer.pad_id == 0
    inner = Inner(models.WordLevel({"a": 0, "b": 1, "</s>": 2}, unk_token="a"))
    only_end = new_tokenizer(inner, None, "</s>", "</s>")
    assert (only_end.eos_id, only_end.pad_id) == (2, 1)


def test_files_are_written_back_byte_for_byte(tmp_path: Path) -> None:
    save_tokenizer(load_tokenizer(FOLDER), tmp_path)
    for name in ("tokenizer.json", "tokenizer_config.json", "chat_template.jinja"):
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes()
    (tmp_path / "tokenizer.json").write_text("{}")
    with pytest.raises(UserError, match="damaged"):
        load_tokenizer(tmp_path)
    (tmp_path / "tokenizer.json").unlink()
    with pytest.raises(UserError, match=r"tokenizer\.json"):
        load_tokenizer(tmp_path)


def test_a_model_without_a_template_says_so() -> None:
    inner = Inner(models.WordLevel({"a": 0, "</s>": 1, "<pad>": 2}, unk_token="a"))
    with pytest.raises(UserError, match="no chat template"):
        new_tokenizer(inner, None, "</s>", "<pad>").chat(MESSAGES)
