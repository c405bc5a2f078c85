"""Training through the public API, and what can be done with the run it leaves."""

import json
import shutil
from pathlib import Path

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thorndike as td
from thorndike.api import Result
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError
from thorndike.networks.network import Network
from thorndike.training.run_directory import checkpoints, read_run
from thorndike.training.sealed_folders import intact
from training import tiny_environments
from training.tiny_environments import PPO_SETTINGS, Corridor, CountedFromThree, DictCorridor

pytestmark = pytest.mark.usefixtures("quick_compile")
OBS = np.array([[0.1, 0.0, -0.1, 0.2], [0.0, 1.0, 0.1, -0.2], [0.0, 0.0, 0.0, 0.0]], np.float32)
STEPS, SEEDS = 320, 2


def tiny_run(output: Path, **changes) -> Result:
    """PPO on the compiled CartPole, normalised: 10 iterations of 32 steps."""
    request = {"steps": STEPS, "seeds": SEEDS, "num_envs": 4, "settings": PPO_SETTINGS, "preset": "none", "output": output}
    normalised = [wrappers.normalize_observation(), wrappers.normalize_reward(0.99)]
    return td.train("ppo", "CartPole-v1", **(request | {"checkpoint_every": 160, "wrappers": normalised} | changes))


@pytest.fixture(scope="module")
def trained(tmp_path_factory, quick_compile) -> Result:
    return tiny_run(tmp_path_factory.mktemp("runs"), name="tiny", command="thorndike train ppo CartPole-v1")


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A copy of the run, to be changed."""
    return Path(shutil.copytree(trained.run, tmp_path / "run"))


def test_the_result_says_what_was_done(trained):
    assert (trained.status, trained.steps, trained.seeds) == ("finished", STEPS, SEEDS)
    assert 0 < trained.compile_s <= trained.cpu_s
    assert trained.wall_s > 0
    assert trained.steps_per_s > 0 and trained.steps_per_cpu_s > 0
    assert 8 <= trained.mean_return <= 100, "a new policy's CartPole falls after about 20 steps"


def test_a_checkpoint_is_a_policy_too(run):
    newest, last, older = td.load(run), td.load(run, checkpoint=320), td.load(run, checkpoint=160)
    for one in ("actors", "statistics"):
        ours, theirs, before = (jax.tree.leaves(getattr(each.policy, one)) for each in (newest, last, older))
        assert all(map(np.array_equal, ours, theirs))
        assert not any(map(np.array_equal, ours, before))
    assert (older.checkpoint, older.seeds[1].checkpoint, newest.checkpoint) == (160, 160, None)
    assert older.evaluate(episodes=2).mean > 0
    assert not (run / "evaluations.jsonl").exists(), "they are the run's own, which its newest policy plays"
    with pytest.raises(UserError, match="has no checkpoint of step 7: it has those of 160, 320"):
        td.load(run, checkpoint=7)


def test_the_run_directory_holds_all_of_it(trained):
    record = read_run(trained.run)
    expected = {
        "algorithm": "ppo",
        "environment": "CartPole-v1",
        "engine": "native",
        "steps": STEPS,
        "seeds": SEEDS,
        "seed": 0,
        "num_envs": 4,
    }
    assert expected.items() <= record.items()
    assert {"status": "finished", "steps_done": STEPS, "command": "thorndike train ppo CartPole-v1"}.items() <= record.items()
    assert record["config"]["n_steps"] == 8 and record["config"]["gamma"] == 0.99, "settings and defaults"
    assert [path.name for path in checkpoints(trained.run)] == ["160", "320"]
    assert all(intact(folder) for folder in [*checkpoints(trained.run), trained.run / "policy"])
    lines = [json.loads(line) for line in (trained.run / "metrics.jsonl").read_text().splitlines()]
    assert [line["steps"] for line in lines] == list(range(32, STEPS + 1, 32))
    assert all(len(line["train/loss"]) == SEEDS for line in lines)
    assert td.runs(trained.run.parents[2]) == [trained.run]
    assert trained.run.parent.parent.name == "CartPole-v1"


def test_nothing_executable_is_written(trained):
    allowed = {".json", ".jsonl", ".safetensors"}
    assert {path.suffix for path in trained.run.rglob("*") if path.is_file() and "tfevents" not in path.name} <= allowed


def test_a_loaded_policy_acts_on_one_observation_and_on_a_batch(trained):
    policy = td.load(trained.run)
    batch, _ = policy.predict(OBS)
    assert batch.shape == (3,)
    np.testing.assert_array_equal(batch, [policy.predict(obs)[0] for obs in OBS])
    np.testing.assert_array_equal(batch, td.load(trained.run).predict(OBS)[0])
    drawn = np.array([policy.predict(OBS, deterministic=False)[0] for _ in range(60)])
    assert set(np.unique(drawn)) == {0, 1}
    assert policy.value(OBS).shape == (3,) and policy.value(OBS[0]).shape == ()


def test_each_seed_is_there_and_the_best_is_the_default(trained):
    policy = td.load(trained.run)
    rows = [json.loads(line)["rollout/ep_rew_mean"] for line in (trained.run / "metrics.jsonl").read_text().splitlines()]
    last = [row for row in rows if any(value is not None for value in row)][-10:]
    best = int(np.argmax([np.mean([row[seed] for row in last if row[seed] is not None]) for seed in range(SEEDS)]))
    assert policy.facts["best"] == best
    np.testing.assert_allclose(policy.value(OBS), policy.seeds[best].value(OBS), rtol=1e-5)
    assert not np.allclose(policy.value(OBS), policy.seeds[1 - best].value(OBS))


def test_normaliser_statistics_are_exported_with_the_policy(trained):
    policy = td.load(trained.run)._policy
    (moments,), rewards = policy.statistics
    assert np.asarray(rewards.seen).tolist() == [STEPS] * SEEDS
    assert np.asarray(moments.seen).tolist() == [STEPS] * SEEDS
    assert moments.mean.shape == (SEEDS, 4)
    assert (np.asarray(moments.variance)[:, 1] > 0.01).all(), "velocities vary"
    # The learner sees (obs - mean) / deviation.
    actor, own = jax.tree.map(lambda leaf: leaf[policy.best], (policy.actors, moments))
    normalised = (OBS - own.mean[None]) / np.sqrt(own.variance + 1e-8)[None]
    np.testing.assert_allclose(policy.value(OBS), policy.algorithm.value(actor, jnp.asarray(normalised)), rtol=1e-4, atol=1e-5)


def test_evaluation_plays_the_same_episodes_of_every_seed_and_keeps_them(run):
    policy = td.load(run)
    found = policy.evaluate(episodes=6, seed=3)
    assert (found.episodes, found.environment, len(found.per_seed)) == (6, "CartPole-v1", SEEDS)
    assert found.min <= found.mean and found.ci95[0] <= found.mean <= found.ci95[1]
    lines = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    assert len(lines) == 6 * SEEDS
    kept = {"evaluation_seed", "deterministic", "seed", "episode", "return", "length", "terminated", "value", "discounted_return"}
    assert set(lines[0]) == kept
    assert all(line["return"] == line["length"] for line in lines), "CartPole pays 1 a step, and no normalised reward"
    assert policy.evaluate(episodes=6, seed=3) == found


def test_a_damaged_policy_is_refused_in_one_line(run):
    path = run / "policy" / "policy.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(UserError, match="is damaged") as error:
        td.load(run)
    assert "\n" not in str(error.value)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(UserError, match="no such directory"):
        td.load(tmp_path / "nothing")
    with pytest.raises(UserError, match="has not reached its first checkpoint"):
        td.load(tmp_path)
    with pytest.raises(UserError, match="is no run"):
        td.resume(tmp_path)


def test_a_wrong_observation_is_refused(trained):
    with pytest.raises(UserError, match="this policy takes one observation of Box"):
        td.load(trained.run).predict(np.zeros(5))


def test_a_finished_run_is_trained_further(run, trained):
    longer = td.resume(run, steps=STEPS + 160)
    assert (longer.status, longer.steps) == ("finished", STEPS + 160)
    assert read_run(run)["steps"] == STEPS + 160
    steps = [json.loads(line)["steps"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(32, STEPS + 161, 32))
    assert not np.allclose(td.load(run).value(OBS), td.load(trained.run).value(OBS))


def test_a_damaged_checkpoint_gives_way_to_the_one_before_it(run, trained):
    (run / "checkpoints" / "320" / "state.safetensors").write_bytes(b"half")
    resumed = td.resume(run)
    assert resumed.steps == STEPS
    same = [(path / "policy" / "policy.safetensors").read_bytes() for path in (run, trained.run)]
    assert same[0] == same[1]
    for folder in checkpoints(run):
        shutil.rmtree(folder)
    with pytest.raises(UserError, match="no intact checkpoint"):
        td.resume(run)


class OneLayer(nn.Module):
    outputs: int

    @nn.compact
    def __call__(self, obs):
        x = nn.tanh(nn.Dense(6)(obs))
        return nn.Dense(self.outputs)(x), nn.Dense(1)(x)[..., 0]


def own_network(spec, outputs: int) -> Network:
    module = OneLayer(outputs)
    return Network(module.init, module.apply)


def test_a_users_own_network_trains_loads_and_goes_on_if_it_is_given_again(tmp_path):
    """On a Box of actions: the policy's are in the environment's units."""
    request = {"num_envs": 4, "preset": "none", "settings": {**PPO_SETTINGS, "target_kl": 0.05}, "output": tmp_path}
    run = td.train("ppo", "Pendulum-v1", steps=64, network=own_network, **request).run
    with pytest.raises(UserError, match="a network of your own"):
        td.load(run)
    with pytest.raises(UserError, match="a network of your own"):
        td.resume(run, steps=96)
    policy = td.load(run, network=own_network)
    assert set(policy._policy.actors["params"]) == {"Dense_0", "Dense_1", "Dense_2"}
    drawn = np.array([policy.predict(np.zeros(3), deterministic=False)[0] for _ in range(50)])
    assert drawn.shape == (50, 1)
    assert 1.2 < abs(drawn).max() <= 2, "the torque goes to 2, where the learner's action goes to 1"
    assert td.resume(run, steps=96, network=own_network).steps == 96


FILE = f"{tiny_environments.__file__}:DictCorridor"


def test_a_users_environment_with_dict_observations_trains_evaluates_and_films_by_its_path(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    run = td.train("ppo", FILE, steps=64, num_envs=4, settings=PPO_SETTINGS, output=tmp_path).run
    policy = td.load(run)
    obs, _ = DictCorridor().reset(seed=0)
    assert policy.predict(obs)[0] in (0, 1)
    found = policy.evaluate(episodes=4)
    assert all(row.length <= 12 for row in found.rows)
    film = policy.watch(tmp_path / "film.mp4", episodes=2)
    assert film.stat().st_size > 500
    assert read_run(run)["environment"] == FILE


def test_actions_that_count_from_three_are_learnt_evaluated_and_predicted(tmp_path):
    """The environment itself asserts that every action is one of its own."""
    learner = td.QLearning(CountedFromThree, num_envs=2, output=tmp_path, n_steps=4, gamma=0.9, learning_rate=0.5, exploration_fraction=1.0)
    learner.learn(2000)
    assert [int(learner.predict(cell)[0]) for cell in range(4)] == [4, 4, 4, 4], "right, from everywhere"
    assert learner.evaluate(10).mean > 0.9
    environment, memory, ends = CountedFromThree(), None, False
    obs, _ = environment.reset(seed=1)
    for _ in range(4):
        action, memory = learner.predict(obs, memory)
        obs, _, ends, _, _ = environment.step(action)
        if ends:
            break
    assert ends


def test_an_environment_object_is_needed_again(tmp_path):
    environment = gymnasium.wrappers.TimeLimit(Corridor(), 5)
    run = td.train("dqn", environment, steps=80, settings={"learning_starts": 16, "net_arch": (8,), "buffer_size": 64}, output=tmp_path).run
    with pytest.raises(UserError, match="was trained on an environment object"):
        td.load(run).evaluate(2)
    with pytest.raises(UserError, match="was trained on an environment object"):
        td.resume(run, steps=120)
    assert all(row.length <= 5 for row in td.load(run, environment=environment).evaluate(2).rows)
    assert td.resume(run, steps=120, environment=environment).steps == 120


def test_a_wrapper_with_a_function_of_the_users_own_is_needed_again_to_go_on_but_not_to_act(tmp_path):
    shaped = [wrappers.shape_reward(lambda obs, action, step: -step.reward), wrappers.frame_stack(2)]
    request = {"steps": 40, "settings": {"n_steps": 5}, "output": tmp_path}
    run = td.train("q_learning", "FrozenLake-v1", wrappers=shaped, **request).run
    assert td.load(run).facts["wrappers"] == [{"name": "frame_stack", "k": 2}]
    assert td.load(run).predict(0)[0] in range(4)
    with pytest.raises(UserError, match=r"your own functions|functions of your own"):
        td.resume(run, steps=60)
    assert td.resume(run, steps=60, wrappers=shaped).steps == 60


def test_native_objects_are_trained_on_as_they_are(tmp_path):
    batch = vectorize(factory("probe/ConstantReward-v0")(), 3)
    found = td.train("q_learning", batch, steps=30, num_envs=3, output=tmp_path, wrappers=[wrappers.discretise(3)])
    assert found.mean_return == 1.0
    assert td.load(found.run, environment=batch).evaluate(2).mean == 1.0


def test_learning_twice_goes_on(tmp_path):
    learner = td.QLearning("FrozenLake-v1", preset="none", output=tmp_path, n_steps=5)
    with pytest.raises(UserError, match=r"call \.learn\(steps\) first"):
        learner.predict(0)
    first = learner.learn(50).result
    assert learner.learn(25).result.run == first.run
    assert learner.result.steps == 75


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"algorithm": "pppo"}, "there is no algorithm 'pppo'; did you mean 'ppo'"),
        ({"environment": "CartPol-v1"}, "did you mean 'CartPole-v1'"),
        ({"settings": {"gama": 0.9}}, "ppo has no setting 'gama'; did you mean 'gamma'"),
        ({"settings": {"gamma": 1.5}}, "gamma"),
        ({"settings": {"learning_rate": "linaer(1, 0)"}}, "learning_rate|a rate is a number"),
        ({"settings": {"n_steps": 5, "batch_size": 7}}, "do not divide into minibatches"),
        ({"algorithm": "dqn", "environment": "Pendulum-v1"}, "dqn takes Discrete actions"),
        ({"algorithm": "q_learning", "preset": "none"}, "the discretise wrapper makes bins"),
        ({"algorithm": "q_learning", "environment": "FrozenLake-v1", "network": own_network}, "has no network"),
        ({"algorithm": "dqn", "settings": {"buffer_size": 3, "n_step": 5}, "preset": "none"}, "make it larger"),
        ({"preset": "fastest"}, "no preset 'fastest'"),
        ({"engine": "warp"}, "unknown engine"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_run(tmp_path, request_, words):
    request = {"algorithm": "ppo", "environment": "CartPole-v1", "steps": 64, "output": tmp_path / "runs"} | request_
    with pytest.raises(UserError, match=words) as error:
        td.train(request.pop("algorithm"), request.pop("environment"), **request)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "runs").exists()


def test_a_learner_refuses_an_unknown_setting_at_once():
    with pytest.raises(UserError, match="did you mean 'learning_rate'"):
        td.PPO("CartPole-v1", learning_rat=1e-3)


class Broken(Corridor):
    def step(self, action):
        raise RuntimeError("the simulator fell over")


def test_a_failure_is_told_and_written_down(tmp_path):
    with pytest.raises(UserError, match="step 1: raised RuntimeError: the simulator fell over"):
        td.train("q_learning", Broken, steps=10, output=tmp_path, wrappers=[wrappers.discretise(2)])
    record = read_run(td.runs(tmp_path)[0])
    assert record["status"] == "failed"
    assert "the simulator fell over" in record["error"]
