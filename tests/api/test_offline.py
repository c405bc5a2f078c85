"""From a trained run to a dataset, to learners from it, to what a policy is worth: through the public names."""

import json
from typing import NamedTuple

import numpy as np
import pytest

import thorndike as td
from thorndike import UserError
from thorndike.api.training_result import Result
from thorndike.cli.main import main
from thorndike.training.datasets import Dataset, episodes_of

SMALL = {"net_arch": (8,), "batch_size": 16}


class Made(NamedTuple):
    folder: object
    run: Result
    data: Dataset


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    """A tiny PPO, and 30 episodes of it with a share of random actions."""
    folder = tmp_path_factory.mktemp("offline")
    run = td.train("ppo", "CartPole-v1", steps=1024, settings={"net_arch": (8,), "n_steps": 32, "batch_size": 64}, output=folder / "runs")
    return Made(folder, run, td.record(run.run, episodes=30, random_share=0.5, to=folder / "mine" / "ppo-v0"))


@pytest.fixture(scope="module")
def continuous(tmp_path_factory) -> Made:
    """A TD3 that has hardly begun, on Pendulum, cut after 20 steps."""
    folder = tmp_path_factory.mktemp("continuous")
    settings = {**SMALL, "learning_starts": 50, "buffer_size": 500}
    run = td.train("td3", "Pendulum-v1", steps=80, settings=settings, max_episode_steps=20, output=folder / "runs")
    return Made(folder, run, td.record(run.run, steps=90, random_share=0.5, to=folder / "mine" / "td3-v0"))


def test_what_is_recorded_is_what_happened(made):
    """Gymnasium, put into the recorded first state, gives the recorded steps."""
    import gymnasium

    assert len(made.data.lengths) == 30
    environment = gymnasium.make("CartPole-v1").unwrapped
    environment.reset()
    for episode in list(episodes_of(made.data))[:3]:
        environment.state = episode.obs[0].astype(np.float64)
        environment.steps_beyond_terminated = None
        for t, action in enumerate(episode.action):
            obs, reward, terminated, *_ = environment.step(int(action))
            np.testing.assert_allclose(obs, episode.obs[t + 1], atol=1e-4)
            assert (reward, terminated) == (episode.reward[t], episode.terminated[t])
            environment.state = episode.obs[t + 1].astype(np.float64)


def test_probabilities_are_those_that_actions_were_drawn_with(made):
    """At least half of the share of random actions each, and what is called p happens as often: the sum of 1 / p counts the actions."""
    data = made.data
    assert (data.probability >= 0.25).all()
    inverse = 1.0 / data.probability
    assert abs(inverse.mean() - 2.0) < 5 * inverse.std() / len(inverse) ** 0.5


def test_deterministic_actions_have_probability_one_and_repeat(made, tmp_path):
    first, again = (td.record(made.run.run, episodes=4, deterministic=True, seed=3, to=tmp_path / f"{name}-v0") for name in "ab")
    assert (first.probability == 1.0).all()
    np.testing.assert_array_equal(first.obs, again.obs)
    policy = td.load(made.run.run)
    np.testing.assert_array_equal(policy.predict(first.obs)[0], first.action)


def test_box_actions_are_recorded_in_the_environments_units(continuous):
    data = continuous.data
    assert (data.lengths == 20).all()
    assert data.lengths.sum() >= 90
    assert np.abs(data.action).max() > 1.0
    assert data.probability is None
    assert (data.truncated.sum(), data.terminated.sum()) == (len(data.lengths), 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 3, "steps": 5}, "not both"),
        ({"random_share": 1.5}, "between 0 and 1"),
        ({"episodes": 0}, "at least one"),
    ],
)
def test_what_cannot_be_recorded_is_told(made, tmp_path, settings, message):
    with pytest.raises(UserError, match=message):
        td.record(made.run.run, to=tmp_path / "no-v0", **settings)


def test_a_learner_from_data_is_a_run_like_any_other(made, tmp_path):
    """Trained, evaluated on the environment of its dataset, resumed bit for bit."""
    kept = {"seeds": 2, "settings": SMALL, "output": tmp_path, "checkpoint_every": 20}
    through = td.train("iql", str(made.data.path), steps=40, **kept)
    half = td.train("iql", str(made.data.path), steps=20, **kept | {"settings": SMALL | {}})
    found = td.load(through.run).evaluate(2)
    assert (found.environment, len(found.per_seed), through.steps) == ("CartPole-v1", 2, 40)
    td.resume(half.run, steps=40)
    first, second = ((result.run / "checkpoints" / "40" / "state.safetensors").read_bytes() for result in (through, half))
    assert first == second


def test_a_learner_of_a_dataset_is_an_object_like_any_other(made, tmp_path):
    """Of its folder or of what was read: it learns, learns further, is evaluated on the dataset's environment, and acts."""
    learner = td.IQL(made.data, output=tmp_path, **SMALL).learn(20)
    assert learner.learn(20).result.steps == 40
    assert learner.evaluate(2).environment == "CartPole-v1"
    assert learner.predict(made.data.obs[0])[0] in (0, 1)
    cloned = td.BC(made.data.path, seeds=2, output=tmp_path, **SMALL).learn(200).result
    last = json.loads((cloned.run / "metrics.jsonl").read_text().splitlines()[-1])
    assert len(last["train/grad_norm/actor/policy"]) == len(last["train/effective_rank/actor"]) == 2
    assert min(last["train/grad_norm/actor/policy"]) > 0 and "train/replay_age" not in last
    with pytest.raises(UserError, match="is a dataset; those that learn from one"):
        td.PPO(made.data, output=tmp_path).learn(20)


def test_a_dataset_that_was_changed_is_not_gone_on_with(made, tmp_path):
    copy = td.mix(made.data.path, made.data.path, to=tmp_path / "mine" / "copy-v0")
    run = td.train("bc", str(copy.path), steps=20, settings=SMALL, output=tmp_path / "runs").run
    other = td.mix(made.data.path, made.data.path, made.data.path, to=tmp_path / "mine" / "other-v0")
    (copy.path / "data" / "main_data.hdf5").write_bytes((other.path / "data" / "main_data.hdf5").read_bytes())
    with pytest.raises(UserError, match="was changed since the run began"):
        td.resume(run, steps=40)


@pytest.mark.slow
def test_awac_goes_on_online_with_its_networks_and_its_replay_filled(continuous, tmp_path):
    offline = td.train("awac", str(continuous.data.path), steps=20, settings=SMALL, output=tmp_path)
    settings = {"buffer_size": 400, "batch_size": 16}
    asked = {"start_from": offline.run, "settings": settings, "seeds": 2, "output": tmp_path, "max_episode_steps": 20}
    online = td.train("awac", "Pendulum-v1", steps=40, checkpoint_every=20, **asked)
    assert online.status == "finished"
    assert json.loads((online.run / "run.json").read_text())["config"]["net_arch"] == [8]
    half = td.train("awac", "Pendulum-v1", steps=20, checkpoint_every=20, **asked | {"settings": settings})
    td.resume(half.run, steps=40)
    assert td.load(half.run).evaluate(2).per_seed == td.load(online.run).evaluate(2).per_seed


def test_the_first_carry_of_an_online_run_holds_the_dataset(continuous, tmp_path):
    from thorndike.api.building import build_job, full_request
    from thorndike.api.starting import first_carry
    from thorndike.environments import registry
    from thorndike.training.presets import EMPTY

    offline = td.train("awac", str(continuous.data.path), steps=20, settings=SMALL, output=tmp_path)
    choice = registry.resolve("Pendulum-v1")
    settings = {**SMALL, "buffer_size": 400}
    request = full_request("awac", choice, EMPTY, None, settings, 40, 1, 2, 0, None, start_from=str(offline.run))
    carry = first_carry(build_job(request, choice, None, None))
    size = len(continuous.data.reward)
    assert carry.learner.replay.size.tolist() == [size, size]
    np.testing.assert_array_equal(np.asarray(carry.learner.replay.rows["obs"])[1, :size], continuous.data.obs)
    assert not np.asarray(carry.learner.replay.rows["terminated"])[:, :size].any()
    assert np.abs(np.asarray(carry.learner.replay.rows["action"])).max() <= 1.0


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (("ppo", "data"), "ppo learns from an environment"),
        (("bc", "CartPole-v1"), "bc learns from a dataset"),
        (("td3_bc", "data"), "td3_bc takes Box actions"),
    ],
)
def test_what_does_not_learn_from_the_source_named_is_told(made, tmp_path, asked, message):
    algorithm, named = asked
    with pytest.raises(UserError, match=message):
        td.train(algorithm, str(made.data.path) if named == "data" else named, output=tmp_path)


def test_what_has_no_meaning_with_a_dataset_is_refused(made, tmp_path):
    for name, value in (("num_envs", 4), ("max_episode_steps", 5), ("engine", "gymnasium"), ("env_kwargs", {"a": 1})):
        with pytest.raises(UserError, match=f"leave {name} out"):
            td.train("bc", str(made.data.path), output=tmp_path, **{name: value})


def test_a_policy_is_judged_from_the_data_of_another(made):
    """Of the very policy that acted, every ratio is near 1, and what importance sampling says is the data's mean."""
    found = td.evaluate_offline(made.run.run, made.data, gamma=0.5, deterministic=False, steps=200)
    assert set(found.estimates) == {"pdis", "wis", "dr", "fqe"}
    assert found.effective_episodes > 10
    assert abs(found.estimates["wis"].value - found.behavior.value) < 0.2
    assert found.behavior.value == pytest.approx(2.0, abs=0.05)


def test_data_that_cannot_tell_are_refused_in_one_line(made, continuous, tmp_path):
    with pytest.raises(UserError, match=r"episodes of .* are worth .* of this policy, wis needs 10") as raised:
        td.evaluate_offline(made.run.run, made.data, methods=["wis"], gamma=0.999)
    assert "\n" not in str(raised.value)
    with pytest.raises(UserError, match="does not hold the probabilities of its actions"):
        td.evaluate_offline(continuous.run.run, continuous.data, methods=["dr"])
    with pytest.raises(UserError, match="give data of its own environment"):
        td.evaluate_offline(made.run.run, continuous.data)
    alone = td.record(made.run.run, episodes=2, deterministic=True, to=tmp_path / "alone-v0")
    turned = alone._replace(action=1 - alone.action)
    with pytest.raises(UserError, match="hardly holds what this policy does"):
        td.evaluate_offline(made.run.run, turned, methods=["fqe"])
    with pytest.raises(UserError, match="gamma is at least 0 and below 1"):
        td.evaluate_offline(made.run.run, made.data, gamma=1.0)


def test_the_verbs_record_train_and_judge(made, tmp_path, capsys):
    place = tmp_path / "mine" / "again-v0"
    words = ["record", str(made.run.run), "--episodes", "3", "--random-share", "0.3", "--to", str(place)]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["episodes"], told["environment"], told["probabilities"]) == (3, "CartPole-v1", True)
    assert main([*words, "--json"]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["train", "bc", str(place), "--steps", "20", "--set", "net_arch=8", "--output", str(tmp_path / "runs"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 20
    asked = ["ope", str(made.run.run), "--data", str(made.data.path), "--gamma", "0.5", "--fqe-steps", "50", "--stochastic"]
    assert main([*asked, "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["estimates"]) == {"pdis", "wis", "dr", "fqe"}
    assert main(asked) == 0
    assert "wis:" in capsys.readouterr().out
