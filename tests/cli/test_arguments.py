"""What users of other libraries type means what they think; the order of words does not matter."""

import json
from pathlib import Path

import pytest

from thorndike.cli import train
from thorndike.cli.answer import as_json_text
from thorndike.cli.main import HELP, VERBS, main
from thorndike.errors import UserError

PLAIN = ["ppo", "CartPole-v1", "--steps", "50000", "--num-envs", "4"]


@pytest.mark.parametrize(
    "words",
    [
        ["--steps", "50_000", "ppo", "--num-envs", "4", "CartPole-v1"],
        ["--algo", "ppo", "--env", "CartPole-v1", "-n", "50000", "--n-envs", "4"],
        ["ppo", "--env-id", "CartPole-v1", "--total-timesteps", "5e4", "--num-envs", "4"],
        ["--algo=ppo", "CartPole-v1", "--total_timesteps=50k", "--num_envs=4"],
        ["CartPole-v1", "--algo", "ppo", "--n_timesteps", "0.05M", "--n_envs", "4"],
    ],
)
def test_other_spellings_mean_the_same(words):
    plain, options = train._parse(PLAIN), train._parse(words)
    assert train.names(options) == train.names(plain) == ("ppo", "CartPole-v1")
    assert (options.steps, options.num_envs) == (plain.steps, plain.num_envs) == (50_000, 4)


def test_settings_stand_as_flags_too():
    options = train._parse(["ppo", "CartPole-v1", "--set", "gamma=0.9", "--learning_rate", "1e-3", "--n-steps=64"])
    assert train.given_settings(options, "ppo") == {"gamma": 0.9, "learning_rate": 1e-3, "n_steps": 64}


def test_a_run_may_be_named_like_an_algorithm():
    assert train.named_algorithm(["--name", "ppo", "dqn", "CartPole-v1"]) == "dqn"


def test_settings_of_another_algorithm_are_no_flags():
    with pytest.raises(UserError, match="unknown flag --buffer-size"):
        train._parse(["ppo", "CartPole-v1", "--buffer-size", "10"])


def test_environment_arguments_are_python_literals_or_text():
    texts = ["is_slippery=False", "map_name=8x8", "size=3", "goal:2", "text=a=b"]
    expected = {"is_slippery": False, "map_name": "8x8", "size": 3, "goal": 2, "text": "a=b"}
    assert train.given_env_kwargs(texts) == expected


def test_help_names_every_verb_and_shows_examples(capsys):
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n  {verb}" in out for verb in VERBS)
    assert "thorndike train ppo CartPole-v1 --seeds 8" in out
    assert max(map(len, HELP.splitlines())) <= 120


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_has_help(verb, capsys):
    with pytest.raises(SystemExit) as left:
        main([verb, "--help"])
    assert left.value.code == 0
    assert f"usage: thorndike {verb}" in capsys.readouterr().out


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("thorndike 0.")


def test_json_has_null_where_there_is_no_number():
    text = as_json_text({"a": float("nan"), "b": [float("inf"), 1, True], "c": Path("x/y"), "d": {"e": None}})
    assert json.loads(text) == {"a": None, "b": [None, 1, True], "c": "x/y", "d": {"e": None}}


def test_an_interruption_is_status_130(capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("thorndike.cli.list.run", interrupted)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "thorndike: interrupted\n"
