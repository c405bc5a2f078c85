"""Runs that were stopped, killed, damaged, or made again."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import pytest

import thorndike as td
from thorndike.cli.main import main
from thorndike.environments import wrappers
from thorndike.errors import UserError
from thorndike.training import machine
from thorndike.training.metrics import MetricsLog
from thorndike.training.run_directory import checkpoints, read_run, write_json
from thorndike.training.run_lock import run_lock
from training.damage import DAMAGES, HOSTILE, seal_again
from training.kill_and_resume import CASES, command, difference, environment, kill_at_random, lines_of, run_below, try_case
from training.tiny_environments import PPO_SETTINGS, Corridor, InterruptedCorridor

pytestmark = pytest.mark.usefixtures("quick_compile")
TABLE = {"steps": 400, "seeds": 2, "num_envs": 2, "settings": {"n_steps": 5}, "preset": "none", "checkpoint_every": 150}


def table_run(output: Path, **changes) -> Path:
    return td.train("q_learning", "FrozenLake-v1", **(TABLE | {"output": output} | changes)).run


@pytest.fixture(scope="module")
def made(tmp_path_factory, quick_compile) -> Path:
    return table_run(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(made, tmp_path) -> Path:
    """A copy of the run, to be changed."""
    return Path(shutil.copytree(made, tmp_path / "run"))


def change(run: Path, **fields) -> None:
    """Other content for run.json."""
    write_json(run / "run.json", {**read_run(run), **fields})


def quickly() -> dict[str, str]:
    """As these tests compile."""
    return {**environment(), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "THORNDIKE_CACHE": os.environ["THORNDIKE_CACHE"]}


# Killed and terminated.


class Chance:
    """Always the same number: in training, where most can go wrong, and there at this share of the time given."""

    def __init__(self, share: float) -> None:
        self.random = lambda: share


def test_a_run_killed_again_and_again_ends_as_one_that_nothing_happened_to(tmp_path, monkeypatch):
    settings = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "net_arch": (8,)}
    request = {"steps": 40_000, "num_envs": 4, "settings": settings, "preset": "none", "checkpoint_every": 1600}
    whole = td.train("ppo", "CartPole-v1", output=tmp_path / "whole", **request).run
    words = ["train", "ppo", "CartPole-v1", "--steps=40k", "--num-envs=4", "--preset=none", "--checkpoint-every=1600"]
    words += [f"--output={tmp_path / 'killed'}", *(f"--set={name}={value}" for name, value in (settings | {"net_arch": 8}).items())]
    monkeypatch.setattr("training.kill_and_resume.environment", quickly)
    for _ in range(2):
        run = run_below(tmp_path / "killed")
        assert kill_at_random(words if run is None else ["resume", str(run)], tmp_path / "killed", Chance(0.5), 0.4)
    run = run_below(tmp_path / "killed")
    assert 0 < lines_of(run) <= lines_of(whole)
    assert read_run(run)["status"] == "running"
    assert td.resume(run).status == "finished"
    assert difference(whole, run) is None


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_runs_killed_at_fifty_random_moments_end_as_one_that_nothing_happened_to(tmp_path, case):
    tally = try_case(case, 50, random.Random(case.name), tmp_path)
    assert tally.kills == 50
    assert tally.in_training > 25
    assert tally.differences == []
    assert tally.unreadable == 0
    assert 0 < tally.lost <= 1


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_a_signal_to_a_command_keeps_the_state_and_is_its_exit_status(tmp_path, number):
    words = ["train", "q_learning", "FrozenLake-v1", "--steps", "40M", "--output", str(tmp_path), "--json"]
    process = subprocess.Popen(command(words), env=quickly(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not lines_of(run_below(tmp_path)) and process.poll() is None:
        time.sleep(0.01)
    began = time.monotonic()
    process.send_signal(number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 128 + number, err
    assert time.monotonic() - began < 5
    answer = json.loads(out)
    assert answer["status"] == "interrupted"
    assert [int(path.name) for path in checkpoints(Path(answer["run"]))][-1] == answer["steps"]
    assert not (Path(answer["run"]) / "lock.json").exists()


def test_a_host_run_stopped_before_its_first_checkpoint_begins_again(tmp_path, capsys):
    request = {"steps": 192, "seeds": 2, "num_envs": 4, "settings": PPO_SETTINGS, "checkpoint_every": 96}
    InterruptedCorridor.steps_made, InterruptedCorridor.presses_at = 0, -1
    whole = td.train("ppo", InterruptedCorridor, output=tmp_path / "whole", **request)
    InterruptedCorridor.steps_made, InterruptedCorridor.presses_at = 0, 4 * 2 * 8 + 5
    stopped = td.train("ppo", InterruptedCorridor, output=tmp_path / "stopped", **request)
    assert (stopped.status, stopped.steps, stopped.saved_steps, stopped.signal) == ("interrupted", 64, 0, signal.SIGINT)
    assert "resume goes on from step 0, not from 64" in capsys.readouterr().err
    assert td.resume(stopped.run, environment=InterruptedCorridor).status == "finished"
    assert "was stopped before its first checkpoint: it begins again" in capsys.readouterr().err
    assert difference(whole.run, stopped.run) is None


def test_a_run_stopped_between_its_last_checkpoint_and_its_policy_gets_the_policy(run, made):
    shutil.rmtree(run / "policy")
    (run / "policy").mkdir()
    change(run, status="running")
    td.resume(run)
    assert difference(made, run) is None


@pytest.mark.parametrize("engine", ["native", "gymnasium"])
def test_a_run_that_was_evaluated_and_watched_on_the_way_trains_to_the_same_bytes(tmp_path, engine, monkeypatch):
    pytest.importorskip("imageio_ffmpeg")
    request = {
        "steps": 192,
        "num_envs": 4,
        "seeds": 2,
        "settings": PPO_SETTINGS,
        "preset": "none",
        "engine": engine,
        "checkpoint_every": 64,
    }
    whole = td.train("ppo", "CartPole-v1", output=tmp_path / "whole", **request).run
    monkeypatch.setattr(MetricsLog, "write", stops_after(3, MetricsLog.write))
    stopped = td.train("ppo", "CartPole-v1", output=tmp_path / "stopped", **request)
    monkeypatch.undo()
    assert stopped.status == "interrupted"
    assert main(["eval", str(stopped.run), "--episodes", "2", "--json"]) == 0
    assert main(["watch", str(stopped.run), "--video", str(tmp_path / "film.mp4")]) == 0
    policy = td.load(stopped.run)
    policy.evaluate(2, seed=0, deterministic=False)
    assert td.resume(stopped.run).status == "finished"
    assert td.load(stopped.run).evaluate(2).episodes == 2
    assert difference(whole, stopped.run) is None


def stops_after(lines: int, write):
    """``write``, which after so many lines has the process interrupted."""
    written = []

    def then_interrupted(*arguments):
        written.append(1)
        if len(written) == lines:
            signal.raise_signal(signal.SIGINT)
        return write(*arguments)

    return then_interrupted


# What is not as it was.


def test_another_process_that_writes_the_run_is_named_before_jax_is_imported(run):
    script = "import sys; from thorndike.cli.main import main; sys.exit(main(['resume', sys.argv[1]]) + 90 * ('jax' in sys.modules))"
    with run_lock(run):
        with pytest.raises(UserError, match=f"process {os.getpid()} is writing {run}"):
            td.resume(run)
        done = subprocess.run([sys.executable, "-c", script, str(run)], env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"thorndike: process {os.getpid()} is writing {run}: wait until it ends, or stop it with: kill {os.getpid()}\n"


def test_a_machine_that_may_give_other_bits_is_told_of_in_one_line(run, capsys, monkeypatch):
    td.resume(run)
    assert capsys.readouterr().err == ""
    change(run, processors="7")
    monkeypatch.setattr(machine, "self_test", lambda: "other")
    td.resume(run)
    found = "NPROC 1 in place of 7; a test computation gives other bits"
    assert capsys.readouterr().err == f"thorndike: the last bits may differ from those that {run} had: {found}\n"


ELSEWHERE = [
    ({"processors": "2"}, "NPROC 1 in place of 2"),
    ({"versions": {"jax": "0.4.1"}}, f"jax {metadata.version('jax')} in place of 0.4.1"),
    ({"versions": {"jaxlib": "0.4.1"}}, f"jaxlib {metadata.version('jaxlib')} in place of 0.4.1"),
    ({"machine": {"features": "avx9000"}}, "the processor lacks avx9000"),
    ({"machine": {"processor": "Another CPU"}}, "in place of Another CPU"),
    ({"machine": {"xla_flags": "--other"}}, "in place of --other"),
    ({"machine": {"self_test": "0123456789abcdef"}}, "a test computation gives other bits"),
]


@pytest.mark.parametrize(("recorded", "words"), ELSEWHERE, ids=[words for _, words in ELSEWHERE])
def test_what_a_run_recorded_of_another_machine_is_told_in_one_line(run, capsys, recorded, words):
    (name, value), before = next(iter(recorded.items())), read_run(run)
    change(run, **{name: before[name] | value if isinstance(value, dict) else value})
    assert main(["resume", str(run), "--json"]) == 0
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and told.startswith(f"thorndike: the last bits may differ from those that {run} had: ")
    assert words in told and ";" not in told, "what differs, and nothing else"


WRONG = [
    ("seeds", "x", "'seeds' is 'x', but it must be a whole number"),
    ("seeds", 10**12, "'seeds' is 1000000000000"),
    ("seed", -1, "'seed' is -1"),
    ("steps", True, "'steps' is True"),
    ("steps", 1e300, "'steps' is 1e"),
    ("environment", "two\nlines", "'environment' is"),
    ("environment", None, "'environment' is None"),
    ("environment", "FrozenLak-v1", "FrozenLak-v1"),
    ("algorithm", "q_learnin", "did you mean 'q_learning'"),
    ("algorithm", ["ppo"], "'algorithm' is"),
    ("algorithm", "planning", "is a plan"),
    ("config", [], "'config' is"),
    ("config", {"total_steps": 9, "gamma": "x"}, "gamma = 'x', but it must be a number"),
    ("config", {"total_steps": 9, "gamma": float("nan")}, "gamma = nan, but it must be between 0 and 1"),
    ("config", {"total_steps": 9, "gamma": [[1]]}, "gamma = ([1],), but it must be a number"),
    ("config", {"__class__": 1}, "has no setting '__class__'"),
    ("wrappers", ["frame_stack"], "'wrappers' is"),
    ("wrappers", [{"name": "frame_stack", "k": "x"}], "run.json is damaged: nothing can be made of it"),
    ("wrappers", [{"name": ["frame_stack"]}], "run.json is damaged: nothing can be made of it"),
    ("env_kwargs", {"nonsense": 1}, "nonsense"),
    ("env_kwargs", 5, "'env_kwargs' is 5"),
    ("engine", "warp", "unknown engine 'warp'"),
    ("checkpoint_every", 0, "'checkpoint_every' is 0"),
    ("num_envs", 3, "its checkpoints were made with num_envs = 2"),
    ("network", "user", "a network of your own"),
    ("environment_object", True, "environment object"),
]


@pytest.mark.parametrize(("name", "value", "words"), WRONG, ids=[f"{name}={value}"[:40].replace("\n", " ") for name, value, _ in WRONG])
def test_a_run_json_that_was_changed_is_one_line(run, name, value, words):
    change(run, **{name: value})
    with pytest.raises(UserError) as error:
        td.resume(run, steps=500)
    assert words in str(error.value)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


def test_a_field_of_run_json_that_is_missing_is_named(run):
    record = read_run(run)
    del record["checkpoint_every"]
    write_json(run / "run.json", record)
    with pytest.raises(UserError, match=r"run\.json is damaged: it has no 'checkpoint_every'"):
        td.resume(run)


def test_a_failed_resume_leaves_run_json_as_it_was(run):
    for folder in checkpoints(run):
        (folder / "progress.json").unlink()
    before = (run / "run.json").read_bytes()
    with pytest.raises(UserError, match="no intact checkpoint"):
        td.resume(run)
    assert (run / "run.json").read_bytes() == before
    assert not (run / "lock.json").exists()


def test_a_run_cannot_bring_code_of_its_own(run):
    (run / "sub").mkdir()
    (run / "sub" / "evil.py").write_text("raise SystemExit('executed')\n")
    change(run, environment=f"{run}/sub/evil.py:Evil")
    with pytest.raises(UserError, match=r"evil\.py is code, which a run's directory does not hold"):
        td.resume(run)
    facts = json.loads((run / "policy" / "policy.json").read_text())
    (run / "policy" / "policy.json").write_text(json.dumps(facts | {"environment": f"{run}/sub/evil.py:Evil"}))
    seal_again(run / "policy")
    policy = td.load(run)
    assert policy.predict(0)[0] in range(4), "to act, no environment is needed"
    with pytest.raises(UserError, match=r"evil\.py is code"):
        policy.evaluate(2)


def damaged_policies(run: Path, number: int) -> int:
    """Damage the policy in ``number`` ways: each is one line. How many were found."""
    found = 0
    aside = Path(shutil.copytree(run / "policy", run / "aside"))
    for seed in range(number):
        chance = random.Random(seed)
        shutil.rmtree(run / "policy")
        shutil.copytree(aside, run / "policy")
        damage = chance.choice(DAMAGES)
        damage(run / "policy", chance)
        with pytest.raises(UserError) as error:
            td.load(run)
        assert "\n" not in str(error.value) and len(str(error.value)) < 1000, damage.__name__
        assert str(run / "policy") in str(error.value), f"{damage.__name__}: {error.value}"
        found += 1
    return found


def test_a_damaged_policy_is_one_line_and_a_finished_run_writes_it_again(run, made, capsys):
    assert damaged_policies(run, 60) == 60
    assert main(["eval", str(run)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"{run}/policy" in told
    td.resume(run)
    assert difference(made, run) is None


@pytest.mark.slow
def test_a_thousand_damaged_policies_are_one_line(run):
    assert damaged_policies(run, 1000) == 1000


POLICY = [
    ("seeds", 3, "need float32[3"),
    ("seeds", "2", "'seeds' is '2'"),
    ("best", 2, "'best' is 2, but it must be a whole number from 0 to 1"),
    ("observation_space", {"kind": "Discrete", "n": -1, "start": 0}, "nothing can be made of it"),
    ("observation_space", {"kind": "Box", "low": ["x"], "high": ["1"], "shape": [1], "dtype": "float32"}, "nothing can be made of it"),
    ("observation_space", {"kind": "Box", "low": ["0"], "high": ["1"], "shape": [10**9, 10**9], "dtype": "O"}, "nothing can be made of it"),
    ("action_space", {"kind": "Secret"}, "unknown kind"),
    ("action_space", {"kind": "Tuple", "parts": [1]}, "unknown kind"),
    ("algorithm", "os.system", "there is no algorithm"),
    ("wrappers", [{"name": "chain"}], "nothing can be made of it"),
    ("num_envs", 10**9 + 1, "'num_envs' is"),
    ("config", {"total_steps": 9, "n_steps": None}, "n_steps = None, but it must be"),
    ("environment_object", 0, "'environment_object' is 0"),
]


@pytest.mark.parametrize(("name", "value", "words"), POLICY, ids=[f"{name}={value}"[:40] for name, value, _ in POLICY])
def test_hostile_content_of_a_sealed_policy_is_one_line(run, name, value, words):
    facts = json.loads((run / "policy" / "policy.json").read_text())
    (run / "policy" / "policy.json").write_text(json.dumps(facts | {name: value}))
    seal_again(run / "policy")
    with pytest.raises(UserError) as error:
        td.load(run)
    assert words in str(error.value)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


@pytest.mark.parametrize("content", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_json_in_place_of_a_policy_is_one_line(run, content):
    (run / "policy" / "policy.json").write_bytes(content)
    seal_again(run / "policy")
    with pytest.raises(UserError) as error:
        td.load(run)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


# Made again.


def test_a_run_made_again_is_identical(run, capsys):
    assert main(["reproduce", str(run), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == {"run": str(run), "identical": True, "steps": 400, "lines": 40, "checkpoints": [300, 400], "difference": None}
    assert err == ""
    assert main(["reproduce", str(run), "--steps", "77"]) == 0
    assert capsys.readouterr().out == f"identical: {run}, 70 steps made again; compared: 7 lines of metrics.jsonl, no checkpoint\n"


def test_a_run_that_was_stopped_and_trained_further_is_made_again_too(tmp_path):
    run = table_run(tmp_path, steps=90)
    td.resume(run, steps=130)
    found = td.reproduce(run)
    assert (found.identical, found.steps, found.checkpoints) == (True, 130, (90, 130))


def test_the_first_difference_is_named(run, capsys):
    lines = (run / "metrics.jsonl").read_text().splitlines()
    changed = json.loads(lines[20])
    changed["rollout/episodes"][1] += 1
    (run / "metrics.jsonl").write_text("\n".join([*lines[:20], json.dumps(changed), *lines[21:]]) + "\n")
    assert main(["reproduce", str(run)]) == 1
    out = capsys.readouterr().out
    assert f"different: {run}" in out and f"metrics.jsonl, step {changed['steps']}, rollout/episodes: [" in out
    assert "equal until then: 20 lines of metrics.jsonl, no checkpoint" in out


def test_another_seed_is_found_out_and_arrays_are_compared_where_lines_are_gone(run):
    change(run, seed=1)
    assert "metrics.jsonl, step 10, " in td.reproduce(run).difference
    (run / "metrics.jsonl").unlink()
    found = td.reproduce(run)
    assert not found.identical
    assert "checkpoint of step 300, " in found.difference and "numbers differ, the first: " in found.difference


def test_a_host_run_is_made_again_from_its_object(tmp_path):
    request = {
        "steps": 192,
        "num_envs": 4,
        "settings": PPO_SETTINGS,
        "checkpoint_every": 96,
        "wrappers": [wrappers.normalize_observation()],
    }
    run = td.train("ppo", Corridor, output=tmp_path, **request).run
    with pytest.raises(UserError, match="environment object"):
        td.reproduce(run)
    found = td.reproduce(run, environment=Corridor)
    assert (found.identical, found.steps, found.checkpoints) == (True, 192, (96, 192))


def test_with_nothing_to_compare_that_is_said(run):
    with pytest.raises(UserError, match="has left nothing up to step 5 to compare with"):
        td.reproduce(run, steps=5)
