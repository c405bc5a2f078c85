"""A user's mistake is one line on stderr, exit status 2, and no JAX."""

import json
import resource
import subprocess
import sys

import pytest

from thorndike.cli.main import main

MISTAKES = [
    (["train", "ppo", "CartPole-v1", "--keep-checkpoints", "1"], "the 2 newest checkpoints always stay"),
    (["trian", "ppo"], "there is no verb 'trian'; did you mean 'train'?"),
    (["--steps"], "unknown flag --steps; the verb comes first"),
    (["train"], "which algorithm? One of ppo, a2c, reinforce, "),
    (["train", "ppo"], "which environment? Name one, as in: thorndike train ppo CartPole-v1"),
    (["train", "pppo", "CartPole-v1"], "there is no algorithm 'pppo'; did you mean 'ppo'?"),
    (["train", "CartPole-v1", "ppo"], "the algorithm comes first: thorndike train ppo CartPole-v1"),
    (["train", "ppo", "CartPole-v1", "more"], "did not expect 'more'"),
    (["train", "ppo", "CartPole-v1", "--sed", "3"], "unknown flag --sed; did you mean --seed?"),
    (["train", "ppo", "CartPole-v1", "--learning-rat", "3"], "unknown flag --learning-rat; did you mean --learning-rate?"),
    (
        ["train", "ppo", "CartPole-v1", "--seeds", "0"],
        "argument --seeds: expected a whole number of at least 1, such as 8, 100k or 1e6; got '0'",
    ),
    (["train", "ppo", "CartPole-v1", "--seed", "-1"], "argument --seed: expected a whole number of at least 0; got '-1'"),
    (["train", "ppo", "CartPole-v1", "--steps", "many"], "expected a whole number of at least 1, such as 8, 100k or 1e6; got 'many'"),
    (["train", "ppo", "CartPole-v1", "--steps"], "argument --steps: expected one argument"),
    (["train", "ppo", "CartPole-v1", "--engine", "warp"], "invalid choice: 'warp'"),
    (["train", "ppo", "CartPole-v1", "--set", "gamma"], "--set gamma: expected NAME=VALUE, for example --set gamma=0.99"),
    (["train", "ppo", "CartPole-v1", "--set", "gama=0.9"], "ppo has no setting 'gama'; did you mean 'gamma'?"),
    (["train", "ppo", "CartPole-v1", "--set", "gamma=1.5"], "ppo: gamma = 1.5, but it must be between 0 and 1 (default 0.99)"),
    (["train", "ppo", "CartPole-v1", "--gamma", "1.5"], "ppo: gamma = 1.5, but it must be between 0 and 1 (default 0.99)"),
    (["train", "ppo", "CartPole-v1", "--set", "n_steps=x"], "ppo: n_steps = 'x', but it must be a whole number"),
    (["train", "ppo", "CartPole-v1", "--set", "total_steps=9"], "the number of steps is given by --steps"),
    (["train", "ppo", "CartPole-v1", "--env-set", "x"], "--env-set x: expected NAME=VALUE"),
    (["train", "ppo", "CartPol-v1"], "did you mean"),
    (["train", "ppo", "no_such_module_at_all:Env-v0"], "no_such_module_at_all"),
    (["train", "ppo", "CartPole-v1", "--output", "/dev/null/runs"], "--output /dev/null/runs: /dev/null is not a folder"),
    (["bench", "ppo", "CartPole-v1", "--set", "gama=0.9"], "ppo has no setting 'gama'; did you mean 'gamma'?"),
    (["eval", "latest"], "runs/ holds no run yet; make one: thorndike train ppo CartPole-v1"),
    (["eval"], "the following arguments are required: RUN"),
    (["watch", "latest", "--video", "a.gif"], "--video a.gif: a film is written as .mp4"),
    (["resume", "latest", "--steps", "-5"], "expected a whole number of at least 1"),
    (["plot", "latest", "--file", "a.bmp"], "--file a.bmp: a plot is written as .png, .svg, .pdf"),
    (["compare"], "the following arguments are required: RUN"),
    (["compare", "latest", "other"], "runs/ holds no run yet; make one: thorndike train ppo CartPole-v1"),
    (["compare", "latest", "--plot", "a.bmp"], "a plot is written as .png, .svg, .pdf; got 'a.bmp'"),
    (["list", "algos"], "cannot list 'algos'; did you mean 'algorithms'?"),
    (["list", "settings"], "whose settings?"),
    (["list", "settings", "pppo"], "there is no algorithm 'pppo'; did you mean 'ppo'?"),
    (["list", "runs", "ppo"], "did not expect 'ppo' after 'list runs'"),
]


@pytest.mark.parametrize(("words", "message"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_is_one_line_and_status_2(words, message, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["train", "pppo", "CartPole-v1"], ["eval", "latest"], ["nonsense"], ["train", "ppo", "X-v0"]])
def test_with_json_a_mistake_is_also_one_object_on_stdout(words, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json"]) == 2
    out, err = capsys.readouterr()
    assert f"thorndike: {json.loads(out)['error']}\n" == err


REFUSED_EARLY = [
    ["train", "pppo", "CartPole-v1"],
    ["train", "ppo", "CartPole-v1", "--set", "gama=0.9"],
    ["train", "ppo", "CartPol-v1"],
    ["eval", "nothing"],
    ["plot", "nothing"],
    ["compare", "nothing", "other"],
]


@pytest.mark.parametrize("words", REFUSED_EARLY, ids=" ".join)
def test_a_mistake_is_refused_before_jax_in_under_half_a_second(words, tmp_path):
    script = f"import sys; from thorndike.cli.main import main; status = main({words}); sys.exit(99 if 'jax' in sys.modules else status)"
    assert cpu_seconds([sys.executable, "-c", script], tmp_path, status=2) < 0.5


def test_help_takes_under_0_3_seconds(tmp_path):
    assert cpu_seconds([sys.executable, "-m", "thorndike", "--help"], tmp_path, status=0) < 0.3


def cpu_seconds(command, folder, status):
    """The least CPU time of three runs: what others do on the machine at the same time does not count."""
    spent = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert done.returncode == status, done.stderr
        spent.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(spent)
