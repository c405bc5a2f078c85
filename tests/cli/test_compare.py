"""``thorndike compare``: one object, or a table and a sentence."""

import json

import pytest

from made_up_runs import write_run
from thorndike.cli.main import main

HIGH, LOW = [500.0, 499.0, 500.0, 498.0, 500.0, 470.0], [301.0, 280.0, 310.0, 295.0, 320.0, 333.0]
NEAR = [471.0, 479.0, 500.0, 497.0, 490.0, 480.0]


@pytest.fixture
def output(tmp_path):
    folder = tmp_path / "runs"
    for algorithm, scores in (("ppo", HIGH), ("dqn", LOW), ("a2c", NEAR), ("few", HIGH[:2])):
        curves = [[value / 2 for value in scores], scores]
        write_run(folder / "CartPole-v1" / algorithm / f"20260101-120000-{algorithm}", scores, algorithm=algorithm, curves=curves)
    write_run(folder / "CartPole-v1" / "dqn" / "20260102-120000-more", LOW, algorithm="dqn", seed=1)
    write_run(folder / "Acrobot-v1" / "ppo" / "20260101-120000-elsewhere", HIGH, environment="Acrobot-v1")
    return folder


def compare(words, output, capsys):
    status = main(["compare", *words, "--output", str(output), "--episodes", "2"])
    out, err = capsys.readouterr()
    assert status == 0, err
    return out


def test_json_is_one_object_with_the_verdict_and_a_table_of_runs(output, capsys):
    out = compare(["0-ppo", "0-dqn", "--failed-below", "475", "--json"], output, capsys)
    assert out.count("\n") == 1
    found = json.loads(out)
    assert list(found) == ["verdict", "difference", "ci95", "p_improvement", "more_seeds", "runs"]
    assert (found["verdict"], found["p_improvement"], found["more_seeds"]) == ("better", 1.0, 0)
    assert found["ci95"][0] > 0
    first, baseline = found["runs"]
    assert (first["run"], first["seeds"], first["failed"], first["scores"]) == ("ppo", 6, pytest.approx(1 / 6), {"CartPole-v1": HIGH})
    assert first["against_baseline"]["difference"] == found["difference"] == first["iqm"] - baseline["iqm"]
    assert baseline["against_baseline"] is None


def test_people_get_a_table_and_a_sentence(output, capsys):
    head, first, second, empty, sentence = compare(["0-dqn", "0-ppo"], output, capsys).splitlines()
    assert head.split() == ["run", "seeds", "IQM", "[95", "%]", "mean", "[95", "%]", "min"]
    assert (first.split()[:3], second.split()[-1], empty.strip()) == (["dqn", "6", "306.5"], "470", "")
    assert sentence.startswith("dqn is worse than ppo: interquartile mean -192.8 (95 % interval -2")
    assert sentence.strip().endswith("a seed of dqn beats one of ppo with probability 0.00.")


def test_what_nobody_can_tell_is_said_with_the_seeds_it_would_take(output, capsys):
    found = json.loads(compare(["0-ppo", "0-a2c", "--metric", "mean", "--json"], output, capsys))
    assert found["verdict"] == "cannot tell"
    sentence = compare(["0-ppo", "0-a2c", "--metric", "mean"], output, capsys).splitlines()[-1].strip()
    assert sentence.startswith("Cannot tell ppo from a2c yet: mean +8.333")
    assert sentence.endswith(f"about {found['more_seeds']} more seeds of each would, if the difference is what it seems.")
    sentence = compare(["0-few", "0-dqn"], output, capsys).splitlines()[-1].strip()
    assert "a verdict needs 5 seeds of each; about 3 more seeds" in sentence


def test_runs_with_a_comma_are_one_learner_and_the_baseline_can_be_chosen(output, capsys):
    found = json.loads(compare(["20260101-120000-dqn,0-more", "0-ppo", "--against", "0-a2c", "--json"], output, capsys))
    assert [row["seeds"] for row in found["runs"]] == [12, 6, 6]
    assert [bool(row["against_baseline"]) for row in found["runs"]] == [True, True, False]
    assert found["difference"] == found["runs"][0]["against_baseline"]["difference"]


@pytest.mark.parametrize("name", ["all.png", "all.svg"])
def test_plot_draws_the_comparison(output, tmp_path, capsys, name):
    out = compare(["0-ppo", "0-dqn", "--plot", str(tmp_path / name)], output, capsys)
    assert out.splitlines()[-1].strip() == f"plot: {tmp_path / name}"
    assert (tmp_path / name).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["0-elsewhere", "0-dqn"], "the environments differ, there is none in common: ppo on Acrobot-v1; dqn on CartPole-v1"),
        (["0-ppo"], "expected at least two learners to compare, got ppo on CartPole-v1"),
        (["0-ppo", "0-ppo"], "was given twice"),
        (["0-ppo", "0-nothing"], "there is no run '0-nothing'"),
        (["0-ppo,0-dqn", "0-a2c"], "are not seeds of the same learner: algorithm is ppo and dqn"),
        (["0-ppo", "0-dqn", "--plot", "a.gif"], "a plot is written as .png, .svg, .pdf; got 'a.gif'"),
        (["0-ppo", "0-dqn", "--metric", "median"], "invalid choice: 'median'"),
    ],
)
def test_a_mistake_is_one_line_and_status_2(output, capsys, words, message):
    assert main(["compare", *words, "--output", str(output)]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert message in err
