"""Minari's format, read and written: the real package reads ours, and we read its own; what is malformed is named."""

import gymnasium
import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.dataset.minari_dataset import MinariDataset

from made_up_data import BOX, made_up
from thorndike.errors import UserError
from thorndike.training.datasets import DATA, METADATA, Dataset, Episode, Origin, episodes_of, mixed, read_dataset, write_dataset

CARTPOLE = gymnasium.spec("CartPole-v1")


def stored(folder, data: Dataset):
    return write_dataset(folder, data.origin, list(episodes_of(data)), {})


def assert_same(first: Dataset, second: Dataset) -> None:
    for name in ("obs", "next_obs", "action", "reward", "terminated", "truncated", "lengths"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    assert first.origin == second.origin
    if first.probability is None:
        assert second.probability is None
    else:
        np.testing.assert_array_equal(first.probability, second.probability)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Discrete(2, start=5), BOX], ids=["Discrete", "from 5", "Box"])
def test_what_is_written_is_read_again(space, tmp_path):
    data = made_up(space)
    assert_same(data, read_dataset(stored(tmp_path / "own-v0", data)))


def test_dict_observations_and_multi_discrete_actions_are_kept(tmp_path):
    space = spaces.Dict({"place": spaces.Box(-1, 1, (2,), np.float32), "hand": spaces.Tuple([spaces.Discrete(4)])})
    obs = {"place": np.ones((3, 2), np.float32), "hand": (np.array([0, 1, 3], np.int32),)}
    episode = Episode(obs, np.array([[0, 2], [1, 1]]), np.ones(2), np.array([False, True]), np.zeros(2, bool), None)
    origin = Origin("MadeUp-v0", {"size": 3}, 7, space, spaces.MultiDiscrete([2, 3]))
    found = read_dataset(write_dataset(tmp_path / "dict-v0", origin, [episode], {}))
    assert found.origin == origin
    np.testing.assert_array_equal(found.next_obs["hand"][0], [1, 3])
    np.testing.assert_array_equal(found.action, [[0, 2], [1, 1]])


@pytest.mark.parametrize("space", [spaces.Discrete(2), BOX], ids=["Discrete", "Box"])
def test_minari_reads_ours(space, tmp_path):
    data = made_up(space)
    data = data._replace(origin=data.origin._replace(environment="CartPole-v1" if space != BOX else "Pendulum-v1"))
    theirs = MinariDataset(stored(tmp_path / "made" / "up-v3", data) / "data")
    assert (theirs.total_episodes, theirs.total_steps, theirs.id) == (3, 16, "made/up-v3")
    assert theirs.action_space == space
    assert theirs.env_spec.id == data.origin.environment
    for ours, episode in zip(episodes_of(data), theirs.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(episode.observations, ours.obs)
        np.testing.assert_array_equal(episode.actions, ours.action)
        np.testing.assert_allclose(episode.rewards, ours.reward)
        np.testing.assert_array_equal(episode.terminations, ours.terminated)
        np.testing.assert_array_equal(episode.truncations, ours.truncated)


@pytest.mark.parametrize("environment", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.filterwarnings("ignore")
def test_what_minari_wrote_is_read_and_survives_our_writing(environment, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    collector = minari.DataCollector(gymnasium.make(environment, max_episode_steps=12))
    collector.action_space.seed(0)
    for seed in range(3):
        collector.reset(seed=seed)
        over = False
        while not over:
            *_, terminated, truncated, _ = collector.step(collector.action_space.sample())
            over = terminated or truncated
    theirs = collector.create_dataset("test/collected-v0", algorithm_name="random")
    found = read_dataset(tmp_path / "test" / "collected-v0")
    assert (found.origin.environment, found.origin.max_episode_steps, found.probability) == (environment, 12, None)
    for ours, episode in zip(episodes_of(found), theirs.iterate_episodes(), strict=True):
        np.testing.assert_array_equal(ours.obs, episode.observations)
        np.testing.assert_array_equal(ours.action, episode.actions)
        np.testing.assert_allclose(ours.reward, episode.rewards, rtol=1e-6)
        np.testing.assert_array_equal(ours.terminated, episode.terminations)
        np.testing.assert_array_equal(ours.truncated, episode.truncations)
    assert_same(found, read_dataset(stored(tmp_path / "again-v0", found)))


def test_an_episode_that_was_cut_off_has_a_future(tmp_path):
    data = made_up(lengths=(4,))
    episode = next(iter(episodes_of(data)))._replace(terminated=np.zeros(4, bool))
    found = read_dataset(write_dataset(tmp_path / "cut-v0", data.origin, [episode], {}))
    assert found.truncated.tolist() == [False, False, False, True]
    assert not found.terminated.any()


def replace(group, name, values):
    del group[name]
    group.create_dataset(name, data=values)


DAMAGE = {
    "it has no rewards": lambda group: group.__delitem__("rewards"),
    "6 actions for 7 rewards": lambda group: replace(group, "actions", np.zeros(6, int)),
    "7 observations for 7 rewards": lambda group: replace(group, "observations", np.zeros((7, 3), np.float32)),
    r"rows of shape \(2,\)": lambda group: replace(group, "observations", np.zeros((8, 2), np.float32)),
    "the number of step 2 is not finite": lambda group: replace(group, "rewards", [0, 0, np.nan, 0, 0, 0, 0]),
    "the action of step 1 is outside": lambda group: replace(group, "actions", [0, 5, 0, 0, 0, 0, 0]),
    "it ends at step 3, but has 7 steps": lambda group: replace(group, "terminations", [False] * 3 + [True] + [False] * 3),
    "expected numbers": lambda group: replace(group, "rewards", [b"x"] * 7),
    "is not above 0 and at most 1": lambda group: replace(group["infos"], "behavior_probability", [0.0] * 7),
    "3 behavior_probability for 7": lambda group: replace(group["infos"], "behavior_probability", [0.5] * 3),
}


@pytest.mark.parametrize("message", DAMAGE)
def test_what_is_malformed_is_named_with_its_file_and_episode(message, tmp_path):
    place = stored(tmp_path / "bad-v0", made_up())
    with h5py.File(place / DATA, "a") as file:
        DAMAGE[message](file["episode_1"])
    with pytest.raises(UserError, match=message) as raised:
        read_dataset(place)
    assert "main_data.hdf5, episode_1" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda place: (place / DATA).write_bytes(b"no HDF5"), "cannot be read as HDF5"),
        (lambda place: (place / DATA).unlink(), "cannot be read as HDF5"),
        (lambda place: (place / METADATA).unlink(), "is no dataset"),
        (lambda place: (place / METADATA).write_text("{"), "metadata.json is damaged"),
        (lambda place: (place / METADATA).write_text("{}"), "does not name the environment"),
        (lambda place: (place / METADATA).write_text('{"env_spec": "{}"}'), "'environment' is None"),
    ],
)
def test_files_that_are_no_dataset_are_told_in_one_line(spoil, message, tmp_path):
    place = stored(tmp_path / "bad-v0", made_up())
    spoil(place)
    with pytest.raises(UserError, match=message) as raised:
        read_dataset(place)
    assert "\n" not in str(raised.value)


def test_a_dataset_is_never_written_over(tmp_path):
    place = stored(tmp_path / "one-v0", made_up())
    with pytest.raises(UserError, match="is there already"):
        stored(place, made_up())


def test_a_mixture_holds_all_episodes_of_its_parts_and_refuses_others(tmp_path):
    first, second = made_up(), made_up(seed=1)
    found = read_dataset(mixed(tmp_path / "both-v0", [first, second]))
    np.testing.assert_array_equal(found.reward, np.concatenate([first.reward, second.reward]))
    other = first._replace(origin=first.origin._replace(environment="Other-v0"))
    with pytest.raises(UserError, match="mix datasets of one"):
        mixed(tmp_path / "none-v0", [first, other])
