"""Tokenizers as transformers' folders hold them: ``tokenizer.json``, special tokens, padding that is never the end."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.errors import UserError
from thorndike.training.json_files import Json, as_bytes, read_object

if TYPE_CHECKING:
    import tokenizers

    from thorndike.language.chat_template import Message

FILE = "tokenizer.json"
_BATCH = 512
_COPIED = (
    FILE, "tokenizer_config.json", "special_tokens_map.json", "chat_template.jinja", "vocab.json", "merges.txt", "tokenizer.model",
    "added_tokens.json",
)  # fmt: skip
_PADDING = ("<pad>", "[PAD]", "<|pad|>", "<|finetune_right_pad_id|>", "<|endoftext|>", "<unk>", "[UNK]")
"""What models pad with whose config names no padding, or names the end of text."""


@dataclass(frozen=True)
class Tokenizer:
    """Text to numbers and back."""

    inner: "tokenizers.Tokenizer"
    bos_id: int | None
    eos_id: int | None
    pad_id: int
    """Never ``eos_id``: a model that is taught to ignore padding would learn never to stop."""
    special_texts: Mapping[str, str] = field(default_factory=dict)
    """What a chat template may name: ``bos_token``, ``eos_token``, ..."""
    template: str | None = None
    """The chat template, in Jinja."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """As they were read: written back byte for byte."""

    @property
    def vocab_size(self) -> int:
        """How many tokens there are, added ones included."""
        return self.inner.get_vocab_size(with_added_tokens=True)

    def encode(self, text: str, special: bool = True) -> list[int]:
        """The tokens of a text; with ``special``, what the tokenizer puts around a text too (a beginning-of-text token)."""
        return list(self.inner.encode(text, add_special_tokens=special).ids)

    def encode_many(self, texts: Sequence[str], special: bool = True) -> list[list[int]]:
        """The same of many texts at once."""
        # Some at a time: what the package keeps of a text is far larger than its tokens.
        parts = (list(texts[begin : begin + _BATCH]) for begin in range(0, len(texts), _BATCH))
        return [list(each.ids) for part in parts for each in self.inner.encode_batch(part, add_special_tokens=special)]

    def decode(self, tokens: Iterable[int], special: bool = False) -> str:
        """The text of tokens; with ``special``, the names of special tokens are kept in it."""
        return self.inner.decode([int(token) for token in tokens], skip_special_tokens=not special)

    def chat(self, messages: "Sequence[Message]", prompt: bool = True) -> str:
        """A conversation as the model was taught to read it; with ``prompt``, up to where it is to answer.

        Raises ``UserError`` where the model has no chat template, or the template refuses the conversation.
        """
        from thorndike.language.chat_template import render

        if self.template is None:
            raise UserError("this model has no chat template (chat_template.jinja): give it plain text, or train it on conversations first")
        return render(self.template, messages, self.special_texts, prompt)

    def encode_chat(self, messages: "Sequence[Message]", prompt: bool = True) -> list[int]:
        """The tokens of a conversation: the template says itself where the text begins."""
        return self.encode(self.chat(messages, prompt), special=False)


def load_tokenizer(folder: Path) -> Tokenizer:
    """The tokenizer in a model's folder. Raises ``UserError`` where it has none, or the package ``tokenizers`` is missing."""
    files = {name: (folder / name).read_bytes() for name in _COPIED if (folder / name).is_file()}
    if FILE not in files:
        raise UserError(f"{folder} has no {FILE}; load and save its tokenizer with transformers (use_fast=True) first")
    return tokenizer_from_files(files, folder)


def tokenizer_from_files(files: Mapping[str, bytes], where: Path) -> Tokenizer:
    """The tokenizer that files describe, by their names."""
    inner = _parsed(files[FILE], where / FILE)
    inner.no_padding()
    inner.no_truncation()
    settings = read_object(where / "tokenizer_config.json") if "tokenizer_config.json" in files else {}
    texts = _special_texts(settings) or _special_texts(_special_tokens_map(files))
    ids = {name: inner.token_to_id(text) for name, text in texts.items()}
    eos = ids.get("eos_token")
    return Tokenizer(
        inner, ids.get("bos_token"), eos, _padding(inner, ids.get("pad_token"), eos), texts, _template(files, settings), dict(files)
    )


def save_tokenizer(tokenizer: Tokenizer, folder: Path) -> None:
    """Write the files of a tokenizer."""
    for name, data in tokenizer.files.items():
        (folder / name).write_bytes(data)


def new_tokenizer(inner: "tokenizers.Tokenizer", bos: str | None, eos: str, pad: str, template: str | None = None) -> Tokenizer:
    """A tokenizer made by the package ``tokenizers``, with the files that transformers reads it from."""
    special = {"eos_token": eos, "pad_token": pad} | ({} if bos is None else {"bos_token": bos})
    settings = special | {"tokenizer_class": "PreTrainedTokenizerFast", "clean_up_tokenization_spaces": False}
    files = {FILE: inner.to_str(pretty=True).encode(), "tokenizer_config.json": as_bytes(settings)}
    if template is not None:
        files["chat_template.jinja"] = template.encode()
    end = inner.token_to_id(eos)
    begin = None if bos is None else inner.token_to_id(bos)
    return Tokenizer(inner, begin, end, _padding(inner, inner.token_to_id(pad), end), special, template, files)


@lru_cache(maxsize=8)
def _parsed_text(text: str) -> "tokenizers.Tokenizer":
    import tokenizers

    return tokenizers.Tokenizer.from_str(text)


def _parsed(data: bytes, where: Path) -> "tokenizers.Tokenizer":
    try:
        return _parsed_text(data.decode())
    except ModuleNotFoundError:
        raise UserError("language models need the package tokenizers: pip install 'thorndike[language]'") from None
    except Exception as error:
        # The package raises plain exceptions for whatever is wrong with a file.
        raise UserError(f"{where} is damaged: {str(error)[:200]}") from error


def _special_texts(settings: Mapping[str, object]) -> dict[str, str]:
    """The special tokens that a config names; a token is a text, or an object that has one."""
    found = {}
    for name in ("bos_token", "eos_token", "unk_token", "sep_token", "pad_token", "cls_token", "mask_token"):
        value = settings.get(name)
        text = value.get("content") if isinstance(value, dict) else value
        if isinstance(text, str):
            found[name] = text
    return found


def _special_tokens_map(files: Mapping[str, bytes]) -> Json:
    try:
        content = json.loads(files.get("special_tokens_map.json", b"{}"))
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _template(files: Mapping[str, bytes], settings: Mapping[str, object]) -> str | None:
    if "chat_template.jinja" in files:
        return files["chat_template.jinja"].decode()
    given = settings.get("chat_template")
    if isinstance(given, list):
        named = {str(each.get("name")): each.get("template") for each in given if isinstance(each, dict)}
        given = named.get("default")
    return given if isinstance(given, str) else None


def _padding(inner: "tokenizers.Tokenizer", named: int | None, eos: int | None) -> int:
    """The named padding unless it is the end; else a token that stands for nothing; else the last one that is not the end."""
    candidates = [named, *(inner.token_to_id(text) for text in _PADDING)]
    usable = [token for token in candidates if token is not None and token != eos]
    size = inner.get_vocab_size(with_added_tokens=True)
    return usable[0] if usable else next(token for token in range(size - 1, -1, -1) if token != eos)
