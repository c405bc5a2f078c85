"""`--config FILE.toml` of the language verbs: the command line wins, and every mistake is one line with file, table and key."""

from pathlib import Path

import pytest

from thorndike.cli.language.aligning import add_training_arguments
from thorndike.cli.language.config_file import STEPS, parse_with_config
from thorndike.cli.main import main
from thorndike.cli.parser import Parser
from thorndike.errors import UserError

EXAMPLE = Path(__file__).parents[2] / "examples" / "rlhf.toml"
WHOLE = """
[ppo]
model = "base"
reward = ["rm", "0.1*my.py:short"]
prompts = "p.jsonl"
out = "runs/ppo"
lora = 8
no_limits = true
target-kl = 5
clip_range_vf = "none"
whiten_rewards = true
learning_rate = 1e-4
[dpo]
beta = 0.2
"""


def parsed(tmp_path: Path, text: str, *words: str):
    (tmp_path / "way.toml").write_text(text)
    parser = Parser("language ppo", "")
    add_training_arguments(parser)
    parser.add_argument("--reward", action="append", required=True)
    parser.add_argument("--prompts", type=Path, action="append", required=True)
    parser.add_argument("--no-limits", action="store_true")
    return parse_with_config(parser, [*words, "--config", str(tmp_path / "way.toml")], "ppo", "ppo")


def test_a_table_says_all_that_the_command_line_can(tmp_path):
    found = parsed(tmp_path, WHOLE)
    assert (found.model, found.out, found.prompts) == (Path("base"), Path("runs/ppo"), [Path("p.jsonl")])
    assert found.reward == ["rm", "0.1*my.py:short"] and found.lora == 8 and found.no_limits and found.seed == 0
    assert found.settings == ["target_kl=5", "clip_range_vf=none", "whiten_rewards=true", "learning_rate=0.0001"]


def test_the_command_line_wins(tmp_path):
    words = ["other", "--reward", "mine", "--lora=2", "--seed", "3", "--set", "target_kl=7", "--out", "elsewhere"]
    found = parsed(tmp_path, WHOLE, *words)
    assert (found.model, found.out, found.reward, found.lora, found.seed) == (Path("other"), Path("elsewhere"), ["mine"], 2, 3)
    assert found.prompts == [Path("p.jsonl")]
    assert found.settings[0] == "target_kl=5" and found.settings[-1] == "target_kl=7", "the last counts"


MISTAKES = {
    "[ppo]\nlearning_rat = 1": "[ppo] learning_rat: there is no such key; did you mean 'learning_rate'?",
    "[ppo]\npromts = 'x'": "[ppo] promts: there is no such key; did you mean 'prompts'?",
    "[ppo]\n[pppo]\nx = 1": "there is no step 'pppo'; did you mean 'ppo'?",
    "ppo = 3": "ppo must be a table",
    "[dpo]\nbeta = 1": "has no table [ppo]; it has [dpo]",
    "[ppo]\nseed = -1": "[ppo] seed: expected a whole number of at least 0",
    "[ppo]\nno_limits = 'yes'": "[ppo] no_limits = 'yes', but it must be true or false",
    "[ppo]\nout = ['a']": "[ppo] out = ['a'], but it must be one text or number",
    "[ppo]\nreward = [['a']]": "[ppo] reward = ['a'], but it must be one text or number",
    "[ppo]\ndevice = 'cpuu'": "[ppo] device = 'cpuu'; did you mean 'cpu'?",
    "[ppo]\ngamma = 2": "[ppo] gamma: ppo: gamma = 2.0, but it must be between 0 and 1",
    "[ppo]\nvalue = 'apart'": "[ppo] value: ppo: value = apart, but it must be one of separate, shared",
    "[ppo]\ngamma = {a = 1}": "[ppo] gamma is a table",
    "[ppo\n": "no TOML",
    "[ppo]\nmodel = 'x'": "the following arguments are required: --out",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_a_mistake_is_one_line_with_file_table_and_key(text, tmp_path):
    with pytest.raises(UserError) as refused:
        parsed(tmp_path, text)
    said = str(refused.value)
    assert MISTAKES[text] in said and "\n" not in said
    assert "required" in said or str(tmp_path / "way.toml") in said


def test_a_file_that_is_not_there_or_no_text(tmp_path, capsys):
    (tmp_path / "bad.toml").write_bytes(b"[ppo]\nmodel = '\xff'")
    for name, expected in {"none.toml": "cannot be read", "bad.toml": "not UTF-8"}.items():
        assert main(["language", "ppo", "--config", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1


@pytest.mark.parametrize("step", [step for step in STEPS if step not in ("pretrain", "label")])
def test_every_table_of_the_example_is_understood(step, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["language", step, "--config", str(EXAMPLE)]) == 2
    assert "is no model: it has no config.json" in capsys.readouterr().err, "read to the end: only the model is missing here"


def test_labelling_reads_it_too(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["language", "label", "--config", str(EXAMPLE)]) == 2
    assert "there is no store prefs.db" in capsys.readouterr().err
    assert main(["language", "label", "--config", str(EXAMPLE), "--db", "mine.db"]) == 2
    assert "there is no store mine.db" in capsys.readouterr().err
    (tmp_path / "x.toml").write_text('[label]\ndb = "prefs.db"\ngold = 2\n')
    assert main(["language", "label", "--config", "x.toml"]) == 2
    assert "x.toml: [label] gold" in capsys.readouterr().err


def test_prompts_of_generate_may_stand_in_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.toml").write_text('[generate]\nmodel = "m"\n')
    assert main(["language", "generate", "--config", "x.toml"]) == 2
    assert "generate needs prompts" in capsys.readouterr().err
    (tmp_path / "x.toml").write_text('[generate]\nmodel = "m"\nprompt = ["The film", "The play"]\nignore_eos = true\n')
    assert main(["language", "generate", "--config", "x.toml"]) == 2
    assert "m is no model" in capsys.readouterr().err


def test_pretraining_reads_it_too(tmp_path, capsys):
    (tmp_path / "x.toml").write_text(EXAMPLE.read_text().replace('corpus = "movie-reviews"', f'corpus = "{tmp_path}/none.txt"'))
    assert main(["language", "pretrain", "--config", str(tmp_path / "x.toml"), "--out", str(tmp_path / "run")]) == 2
    assert "none.txt" in capsys.readouterr().err
