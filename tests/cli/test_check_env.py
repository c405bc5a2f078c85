"""`thorndike check-env`: exit status, text and JSON."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from thorndike.cli.main import main

FILE = Path(__file__).parents[1] / "environments" / "broken_environments.py"
KEYS = {"environment", "seed", "steps", "episodes", "errors", "warnings", "hints", "findings", "checked", "not_checked"}


def check_env(words, capsys):
    status = main(["check-env", *words])
    return status, *capsys.readouterr()


def test_a_healthy_environment_says_so_and_what_was_checked(capsys):
    status, out, _ = check_env(["CartPole-v1", "--steps", "300"], capsys)
    assert status == 0
    first, second, third = out.splitlines()
    assert first.startswith("CartPole-v1: 300 steps with random actions from seed 0, ")
    assert second == "no findings"
    assert third.startswith("checked: spaces, returned values, ")


def test_errors_are_exit_status_1_with_a_fix_each(capsys):
    status, out, _ = check_env([f"{FILE}:Crash", "--steps", "300"], capsys)
    assert status == 1
    lines = out.splitlines()
    assert lines[1].startswith("error    exception: step 8 after reset(seed=0)")
    assert lines[2].startswith("         fix: make step work for every action")
    assert "1 error, 0 warnings, 0 hints" in lines
    assert lines[-1].startswith("not checked, because of the errors: repeating from a seed")


def test_warnings_and_hints_alone_are_exit_status_0(capsys):
    status, out, _ = check_env([f"{FILE}:Endless", "--steps", "300"], capsys)
    assert status == 0
    assert "0 errors, 1 warning, 0 hints" in out


def test_a_time_limit_and_arguments_reach_the_environment(capsys):
    assert "no findings" in check_env([f"{FILE}:Endless", "--steps", "300", "--max-episode-steps", "40"], capsys)[1]
    status, out, _ = check_env(["FrozenLake-v1", "--steps", "300", "--env-set", "is_slippery=False"], capsys)
    assert status == 0
    assert "seed_has_no_effect" in out


def test_json_is_one_object_with_all_there_is(capsys):
    status, out, _ = check_env([f"{FILE}:RewardArray", "--steps", "200", "--seed", "4", "--json"], capsys)
    assert status == 1
    assert out.count("\n") == 1
    found = json.loads(out)
    assert set(found) == KEYS
    assert (found["steps"], found["seed"], found["errors"], found["warnings"]) == (200, 4, 1, 0)
    assert set(found["findings"][0]) == {"severity", "kind", "message", "fix"}
    assert found["findings"][0]["kind"] == "reward_type"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "which environment? Name one, as in: thorndike check-env CartPole-v1"),
        (["CartPol-v1"], "unknown environment 'CartPol-v1'; did you mean 'CartPole-v1'?"),
        (["CartPole-v1", "--step", "5"], "unknown flag --step; did you mean --steps?"),
        ([f"{FILE}:Cartt"], "no environment 'Cartt' there; did you mean 'Cart'?"),
        (["no_such_file.py:Cart"], "there is no file no_such_file.py"),
        (["CartPole-v1", "--env-set", "x"], "--env-set x: expected NAME=VALUE"),
    ],
    ids=["nothing", "id", "flag", "class", "file", "setting"],
)
def test_a_mistake_is_one_line_and_exit_status_2(words, message, capsys):
    status, out, err = check_env(words, capsys)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_a_misspelt_id_is_refused_before_jax():
    script = (
        "import sys; from thorndike.cli.main import main\n"
        "status = main(['check-env', 'CartPol-v1']); sys.exit(status + ('jax' in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 2
