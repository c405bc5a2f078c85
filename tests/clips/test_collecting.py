"""Recording: windows of an episode's own steps in order, whole or ended by termination, and a folder that keeps them."""

from functools import partial

import gymnasium
import numpy as np
import pytest

from environments.counting_environments import CountingEnv, DictCountingEnv
from thorndike.clips.actors import AtRandom
from thorndike.clips.choices import ask, left_to_judge, read_choices, simulate
from thorndike.clips.collecting import Wanted, collect
from thorndike.clips.folder import About, Collection, add_collection, all_segments, begin_folder, collections
from thorndike.clips.segments import Row, segment, together
from thorndike.errors import UserError
from thorndike.language.preferences.judgements import Response
from thorndike.language.preferences.store import Store
from thorndike.training.space_files import space_to_json


class SmallNumbers(CountingEnv):
    """Numbers of episodes that float32 holds."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=None if seed is None else seed % 1000, options=options)
        return self.observe(), {}


def recorded(make, clips=40, length=3, num_envs=5):
    wanted = Wanted(clips, length, num_envs, seed=1, number=2)
    return collect(wanted, make, "counting", lambda engine: AtRandom(engine.spec.action_space, num_envs, (1, 2)), None, str)


def test_a_clip_is_a_stretch_of_one_episode():
    clips = recorded(partial(SmallNumbers, 9))
    assert clips.number == 40 and clips.valid.shape == (40, 3)
    for obs, reward, valid in zip(clips.obs[0], clips.reward, clips.valid, strict=True):
        steps = int(valid.sum())
        episode, count = obs[:steps].T
        assert len(set(episode)) == 1 and (np.diff(count) == 1).all() and count[0] % 3 == 0
        # The environment's reward is the number of the step.
        np.testing.assert_array_equal(reward[:steps], count + 1)
        length, kind = 1 + (int(episode[0]) * 7919) % 9, int(episode[0]) % 3
        if steps < 3:
            assert kind != 1 and count[-1] + 1 == length, "only a termination ends a clip early"
        assert not obs[steps:].any() and not reward[steps:].any()
    assert not clips.all_whole
    np.testing.assert_allclose(clips.returns, (clips.reward * clips.valid).sum(1))
    assert set(np.unique(clips.action)) <= {0, 1}


def test_the_same_seed_records_the_same_and_observations_may_be_of_several_parts():
    first, second = recorded(DictCountingEnv, 10), recorded(DictCountingEnv, 10)
    for one, other in zip(first.obs, second.obs, strict=True):
        np.testing.assert_array_equal(one, other)
    assert [leaf.shape[2:] for leaf in first.obs] == [(), (3,), (2, 2, 1), (2,)]


def test_clips_that_do_not_come_are_one_line(monkeypatch):
    monkeypatch.setattr("thorndike.clips.collecting._MOST_STEPS", 200)
    with pytest.raises(UserError, match=r"\d+ of 40 clips were found in 200 steps: are episodes shorter than 50"):
        recorded(partial(gymnasium.make, "MountainCar-v0", max_episode_steps=10), length=50)


# the folder


@pytest.fixture
def folder(tmp_path):
    made = gymnasium.make("CartPole-v1")
    about = About("CartPole-v1", {}, None, space_to_json(made.observation_space), space_to_json(made.action_space), 2, "Which?")
    begin_folder(tmp_path / "clips", about)
    return tmp_path / "clips"


def collection(number, worths, pairs):
    rows = [[Row((np.full(4, worth, np.float32),), np.int32(1), worth)] * 2 for worth in worths]
    return Collection(number, together([segment(each, 2) for each in rows]), pairs, "random actions", False)


def add(folder, *given):
    for each in given:
        add_collection(folder, each)
        ask(folder, each)


def test_what_is_kept_is_read_back_and_nothing_is_asked_twice(folder):
    add(folder, collection(0, [1.0, 2.0, 3.0], [(0, 1), (2, 1)]), collection(1, [9.0, 0.0], [(1, 0)]))
    add(folder, collection(1, [9.0, 0.0], [(1, 0)]))
    assert [each.segments.number for each in collections(folder)] == [3, 2] and collections(folder)[0].pairs == [(0, 1), (2, 1)]
    assert all_segments(folder).returns.tolist() == [2.0, 4.0, 6.0, 18.0, 0.0]
    assert left_to_judge(folder) == 3


def test_choices_are_places_in_all_clips_and_a_program_judges_by_returns(folder):
    add(folder, collection(0, [1.0, 2.0, 3.0], [(0, 1), (2, 1)]), collection(1, [9.0, 0.0], [(1, 0)]))
    assert simulate(folder, temperature=0.0, error_rate=0.0, seed=0) == 3 and left_to_judge(folder) == 0
    found = read_choices(folder)
    said = {frozenset((a, b)): (a if p == 1.0 else b) for a, b, p in zip(*map(np.ndarray.tolist, found), strict=True)}
    assert said == {frozenset((0, 1)): 1, frozenset((1, 2)): 2, frozenset((3, 4)): 3}
    assert simulate(folder, temperature=0.0, error_rate=0.0, seed=0) == 0


@pytest.mark.parametrize(
    ("temperature", "error_rate", "low", "high"), [(0.0, 0.0, 1.0, 1.0), (0.0, 1.0, 0.35, 0.65), (4.0, 0.0, 0.6, 0.85)]
)
def test_a_program_errs_as_often_as_it_is_told(folder, temperature, error_rate, low, high):
    """Returns differ by 4: at a temperature of 4 Bradley-Terry chooses the better one in 73 % of cases."""
    add(folder, collection(0, [float(n % 2) * 2 for n in range(240)], [(n, n + 1) for n in range(0, 240, 2)]))
    assert simulate(folder, temperature, error_rate, seed=1) == 120
    found = read_choices(folder)
    better = np.where(found.p_first == 1.0, found.first, found.second)
    assert low <= np.mean(better % 2 == 1) <= high


def test_ties_count_half_and_skips_not_at_all(folder):
    add(folder, collection(0, [1.0, 2.0, 3.0], [(0, 1), (1, 2)]))
    with Store(folder / "choices.db") as store:
        from thorndike.language.preferences.assignment import next_assignments

        project, rater = store.project("default"), store.rater("me")
        tied, skipped = next_assignments(store, project, rater, 2)
        store.judge(Response(tied, "tie", "one"))
        store.judge(Response(skipped, "skip", "two"))
    found = read_choices(folder)
    assert found.p_first.tolist() == [0.5] and {*found.first, *found.second} == {0, 1}


def test_a_folder_of_something_else_is_one_line(folder, tmp_path):
    with pytest.raises(UserError, match="was begun with length = 2, not 3"):
        begin_folder(folder, About("CartPole-v1", {}, None, *_spaces(folder), 3, "Which?"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    with pytest.raises(UserError, match="is no folder of clips"):
        begin_folder(tmp_path / "full", About("CartPole-v1", {}, None, *_spaces(folder), 3, "Which?"))
    with pytest.raises(UserError, match="nothing has been recorded"):
        all_segments(folder)


def _spaces(folder):
    from thorndike.clips.folder import read_about

    return read_about(folder)[3:5]
