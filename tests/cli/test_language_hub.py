"""A model by its name on the hub: fetched where it is no folder, and every reason why not in one line."""

import builtins
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, RepositoryNotFoundError

from thorndike.cli.language.hub import model_folder
from thorndike.cli.main import main
from thorndike.errors import UserError


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_a_name_is_fetched_and_what_is_no_name_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def fetch(name: str, *, allow_patterns: list[str], ignore_patterns: list[str]) -> str:
        asked.append((name, allow_patterns, ignore_patterns))
        return str(tmp_path / "cache" / name)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fetch)
    assert model_folder(Path("owner/tiny-1.5")) == tmp_path / "cache" / "owner" / "tiny-1.5"
    assert asked == [("owner/tiny-1.5", ["*.json", "*.safetensors", "*.jinja"], ["*/*"])]
    (tmp_path / "runs" / "base").mkdir(parents=True)
    for path in ("runs/base", "runs/bse", "gpt2", "/owner/name", "a/b/c", "../x", "owner/na me"):
        assert model_folder(Path(path)) == Path(path)
    assert len(asked) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["generate", "owner/name", "--prompt", "a"],
        ["sft", "owner/name", "--data", "d.jsonl", "--out", "o"],
        ["dpo", "owner/name", "--data", "d.jsonl", "--out", "o"],
        ["chat", "owner/name"],
        ["reward", "owner/name", "--data", "d.jsonl", "--out", "o"],
        ["ppo", "owner/name", "--reward", "r", "--prompts", "p.jsonl", "--out", "o"],
        ["eval", "owner/name", "--base", "owner/name", "--reward", "r", "--prompts", "p.jsonl"],
    ],
)
def test_every_verb_takes_one(words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(huggingface_hub, "snapshot_download", lambda name, **patterns: f"fetched/{name}")
    assert main(["language", *words]) == 2
    assert "fetched/owner/name is no model: it has no config.json" in capsys.readouterr().err


REFUSALS = {
    "no network": (LocalEntryNotFoundError("offline"), "cannot be reached"),
    "unknown": (RepositoryNotFoundError.__new__(RepositoryNotFoundError), "no model on the hub"),
    "no name": (HFValidationError("bad"), "no model on the hub"),
    "overloaded": (HfHubHTTPError.__new__(HfHubHTTPError), "the hub does not give owner/name"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_model_that_is_not_to_be_had_is_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    error, expected = REFUSALS[name]

    def fetch(name: str, **patterns: list[str]) -> str:
        raise error

    monkeypatch.setattr(huggingface_hub, "snapshot_download", fetch)
    with pytest.raises(UserError, match=expected) as refused:
        model_folder(Path("owner/name"))
    assert "\n" not in str(refused.value)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = builtins.__import__

    def missing(name: str, *rest):
        if name.startswith("huggingface_hub"):
            raise ModuleNotFoundError(name)
        return plain(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(UserError, match=r"pip install 'thorndike\[hub\]'"):
        model_folder(Path("owner/name"))
