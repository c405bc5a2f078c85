"""The verbs of language models: what they answer, and mistakes in one line."""

import json
from pathlib import Path

import pytest

from language.make_reference import REFERENCE
from thorndike.cli.language import LANGUAGE_VERBS
from thorndike.cli.main import main
from thorndike.language.model import LanguageModel, load_decoder, save_model
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.usefixtures("quick_compile")


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small model made by the command itself."""
    folder = tmp_path_factory.mktemp("language")
    (folder / "texts.txt").write_text("\n\n".join(f"The {what} is {how}." for what in ("film", "play", "book") for how in ("good", "bad")))
    words = ["language", "pretrain", str(folder / "texts.txt"), "--out", str(folder / "base")]
    small = {
        "vocab_size": 270,
        "hidden_size": 16,
        "num_layers": 1,
        "num_heads": 2,
        "intermediate_size": 24,
        "total_steps": 3,
        "batch_size": 2,
    }
    assert main([*words, *(f"--set={name}={value}" for name, value in (small | {"max_length": 16}).items())]) == 0
    return folder / "base" / "model"


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main(["language", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_prompts_are_gone_on_with(base: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["generate", str(base), "--prompt", "The film", "--samples", "2", "--max-new-tokens", "5"]
    found = answer(capsys, *words)
    assert found["rows"][0]["prompt"] == "The film" and len(found["rows"][0]["completions"]) == 2
    assert answer(capsys, *words)["rows"] == found["rows"] != answer(capsys, *words, "--seed", "1")["rows"]
    (tmp_path / "prompts.jsonl").write_text('{"prompt": "The play"}\n{"prompt": "A book"}\n')
    kept = answer(
        capsys, "generate", str(base), "--prompts", str(tmp_path / "prompts.jsonl"), "--max-new-tokens", "3", "--to", str(tmp_path / "out")
    )
    assert kept["prompts"] == 2 == len((tmp_path / "out").read_text().splitlines())


def test_a_model_is_fine_tuned_and_the_same_command_finds_it_done(base: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "data.jsonl").write_text('{"prompt": "The film", "completion": " is odd."}')
    words = [
        "sft",
        str(base),
        "--data",
        str(tmp_path / "data.jsonl"),
        "--held-out",
        str(tmp_path / "data.jsonl"),
        "--out",
        str(tmp_path / "tuned"),
    ]
    words += ["--lora", "2", "--set", "total_steps=4", "--set", "batch_size=2", "--set", "learning_rate=1e-2"]
    found = answer(capsys, *words)
    assert found["status"] == "finished" and found["steps"] == 4 and found["eval/loss"] > 0
    again = answer(capsys, *words)
    assert again["train/loss"] == found["train/loss"]
    adapter = str(tmp_path / "tuned" / "adapter")
    with_adapter = answer(
        capsys, "generate", str(base), "--adapter", adapter, "--prompt", "The", "--temperature", "0", "--max-new-tokens", "4"
    )
    merged = answer(capsys, "generate", found["model"], "--prompt", "The", "--temperature", "0", "--max-new-tokens", "4")
    assert with_adapter["rows"] == merged["rows"]
    assert main(["language", *words, "--seed", "1"]) == 2
    assert "begun with another seed" in capsys.readouterr().err


def test_a_conversation_is_written_out(base: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    lines = iter(["The film\n", "The play\n", "\n"])
    monkeypatch.setattr("sys.stdin.readline", lambda: next(lines))
    assert main(["language", "chat", str(base), "--max-new-tokens", "4"]) == 0
    assert len(capsys.readouterr().out.rstrip("\n").split("\n")) >= 2


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["generat"], "did you mean 'generate'"),
        (["generate", "nowhere", "--prompt", "a"], "no config.json"),
        (["generate", "nowhere"], "--prompt TEXT, or --prompts FILE"),
        (["generate", "nowhere", "--prompt", "a", "--temperature", "-1"], "at least 0"),
        (["sft", "nowhere", "--out", "x"], "--data"),
        (["sft", "nowhere", "--data", "a.jsonl", "--out", "x", "--set", "learning_rat=1"], "did you mean 'learning_rate'"),
        (["pretrain", "none.txt", "--out", "x", "--set", "hidden_size=4"], "at least 8"),
        (["pretrain", "none.txt", "--out", "x"], "none.txt cannot be read"),
        ([], "VERB"),
    ],
)
def test_mistakes_are_one_line(
    words: list[str], expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["language", *words]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1


@pytest.mark.parametrize("verb", LANGUAGE_VERBS)
def test_every_verb_has_help_with_examples(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["language", verb, "--help"])
    out = capsys.readouterr().out
    assert f"usage: thorndike language {verb}" in out and f"  thorndike language {verb}" in out


def test_a_prompt_that_the_model_cannot_read_is_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Its tokenizer has more tokens than the model, or the text is longer than it reads."""
    config, params = load_decoder(REFERENCE / "llama")
    save_model(LanguageModel(config, params, load_tokenizer(REFERENCE / "tokenizer")), tmp_path / "model")
    assert main(["language", "generate", str(tmp_path / "model"), "--prompt", "a " * 200, "--max-new-tokens", "2"]) == 2
    assert "longer than this model can read" in capsys.readouterr().err
