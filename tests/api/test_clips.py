"""Learning from choices between clips, end to end: by hand and in rounds, compiled and on the host, interrupted and gone on with."""

import json
import shutil

import numpy as np
import pytest

import thorndike as td
from thorndike.api.clip_rounds import shares
from thorndike.clips.choices import left_to_judge
from thorndike.clips.folder import collections
from thorndike.clips.reward_files import load_reward, read_reward
from thorndike.training.sealed_folders import SealedFolder
from thorndike.training.tree_files import read_arrays

FIT = {"total_steps": 20, "net_arch": (4,), "members": 2, "batch_size": 4}


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory):
    """Two rounds by hand: clips, choices, a reward, a run; clips of it, another reward, the run gone on with."""
    where = tmp_path_factory.mktemp("clips") / "lake"
    first = td.collect_clips("FrozenLake-v1", where, pairs=6, length=4, films=False)
    judged = td.judge_clips(where, temperature=0.0)
    fitted = td.fit_clips(where, settings=FIT)
    run = td.train("q_learning", "FrozenLake-v1", steps=200, preset="none", output=where / "runs", reward=where, until=100)
    second = td.collect_clips("FrozenLake-v1", where, pairs=6, length=4, films=False, run=run.run)
    td.judge_clips(where, error_rate=0.5)
    other = td.fit_clips(where, settings=FIT, seed=1)
    return where, first, judged, fitted, run, second, other, td.resume(run.run, reward=where)


def learnt_in(run):
    """The reward in each checkpoint of a run."""
    found = [read_arrays(SealedFolder(path), "state") for path in sorted((run / "checkpoints").iterdir(), key=lambda path: int(path.name))]
    return [next(value for name, value in arrays.items() if name.endswith("statistics/0/params"))[0] for arrays in found]


def test_clips_are_recorded_judged_and_learnt_from(by_hand):
    where, first, judged, fitted, *_ = by_hand
    assert (first.pairs, first.made_by, first.chosen_by, judged) == (6, "random actions", "chance", 6)
    assert fitted.report.choices == 6 and fitted.reward == where / "rewards" / "0"
    assert {path.name for path in where.iterdir()} >= {"clips.json", "choices.db", "collections", "rewards"}


def test_a_run_pauses_and_goes_on_with_the_reward_that_more_choices_tell(by_hand):
    where, _, _, fitted, paused, second, other, finished = by_hand
    assert (paused.status, paused.steps, finished.status, finished.steps) == ("interrupted", 100, "finished", 200)
    assert second.made_by == str(paused.run) and second.chosen_by == "disagreement"
    record = json.loads((finished.run / "run.json").read_text())
    assert record["reward"]["path"] == str(fitted.reward) and [each["step"] for each in record["rewards"]] == [100]
    assert record["rewards"][0]["path"] == str(other.reward) and record["wrappers"][0]["name"] == "learned_reward"
    rewards = [np.asarray(load_reward(read_reward(where / "rewards" / str(number))).params) for number in range(2)]
    assert not np.array_equal(*rewards)
    # The two newest checkpoints were written after the change.
    for kept in learnt_in(finished.run):
        np.testing.assert_array_equal(kept, rewards[1])


def test_it_can_be_made_again_up_to_the_change_and_says_so(by_hand):
    run = by_hand[-1].run
    with pytest.raises(td.UserError, match=r"went on with another reward from step 100: .* --steps 100"):
        td.reproduce(run)
    assert td.reproduce(run, steps=100).identical


def test_the_policy_needs_no_clips(by_hand, tmp_path):
    copied = tmp_path / "alone"
    shutil.copytree(by_hand[-1].run, copied)
    policy = td.load(copied)
    action, _ = policy.predict(0)
    assert action in range(4)
    assert "learned_reward" in str(policy.incomparable_values)


def test_what_does_not_fit_is_one_line(by_hand, tmp_path):
    where, run = by_hand[0], by_hand[-1].run
    for refused, why in (
        (lambda: td.train("ppo", "Acrobot-v1", reward=where, output=tmp_path), "learnt from clips of FrozenLake-v1, not of Acrobot-v1"),
        (lambda: td.collect_clips("Acrobot-v1", tmp_path / "a", run=run), "was trained on FrozenLake-v1, not on Acrobot-v1"),
        (lambda: td.collect_clips("FrozenLake-v1", where, length=9), "was begun with length = 4, not 9"),
        (lambda: td.judge_clips(tmp_path), "is no folder of clips"),
        (lambda: td.judge_clips(where, error_rate=2), "an error rate a share"),
        (lambda: td.train("ppo", "CartPole-v1", reward=tmp_path, output=tmp_path), "holds no learnt reward"),
    ):
        with pytest.raises(td.UserError, match=why) as told:
            refused()
        assert "\n" not in str(told.value)


def test_a_reward_that_was_changed_is_refused(by_hand, tmp_path):
    copied = tmp_path / "clips"
    shutil.copytree(by_hand[0] / "rewards" / "0", copied / "rewards" / "0")
    (copied / "rewards" / "0" / "reward.json").write_text("{}")
    with pytest.raises(td.UserError, match="damaged"):
        read_reward(copied / "rewards" / "0")


# in rounds


def rounds(where, **more):
    asked = {"choices": 8, "rounds": 2, "length": 4, "films": False, "fit": FIT, "steps": 200, "engine": "gymnasium"}
    return td.train_on_choices("q_learning", "FrozenLake-v1", where, **{**asked, **more})


@pytest.fixture(scope="module")
def waited(tmp_path_factory):
    """What the same call says again and again, while somebody judges in between."""
    where = tmp_path_factory.mktemp("rounds") / "lake"
    told = []
    while not told or told[-1].status == "waiting":
        told.append(rounds(where))
        if told[-1].left:
            td.judge_clips(where)
    return where, told


def test_rounds_wait_for_people_and_the_same_call_goes_on(waited):
    where, told = waited
    assert [(each.status, each.round, each.left) for each in told] == [("waiting", 1, 2), ("waiting", 2, 6), ("finished", 2, 0)]
    assert told[0].run is None and told[-1].run == told[1].run and told[-1].result.steps >= 200
    assert [each.made_by for each in collections(where)] == ["random actions", str(told[-1].run)]
    record = json.loads((told[-1].run / "run.json").read_text())
    assert [each["path"] for each in record["rewards"]] == [str(where / "rewards" / "1")] and record["status"] == "finished"


def test_what_is_done_is_not_done_again_and_another_plan_is_refused(waited):
    where, told = waited
    again = rounds(where)
    assert (again.status, again.run, again.result) == ("finished", told[-1].run, None)
    assert left_to_judge(where) == 0 and len(collections(where)) == 2
    with pytest.raises(td.UserError, match=r"was begun with choices = \[2, 6\]"):
        rounds(where, choices=12)


def test_choices_are_shared_out():
    assert shares(500, 5) == [125, 94, 94, 94, 93] and sum(shares(7, 3)) == 7 and shares(4, 1) == [4]
    with pytest.raises(td.UserError, match="two choices a round"):
        shares(3, 2)


def test_films_are_kept_of_the_clips_that_are_asked(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("pygame")
    td.collect_clips("CartPole-v1", tmp_path / "seen", pairs=1, length=3)
    films = sorted(path.name for path in (tmp_path / "seen" / "films").iterdir())
    assert films == ["0-0.mp4", "0-1.mp4"]
    assert all((tmp_path / "seen" / "films" / name).read_bytes()[4:8] == b"ftyp" for name in films)


@pytest.mark.slow
def test_500_choices_reach_four_fifths_of_what_the_true_reward_gives(tmp_path):
    """Five seeds on Pendulum-v1; returns are negative, so both readings: the gain over random actions (-1,208), and the plain ratio."""
    told, true, learner = [], [], {"steps": 150_000, "settings": {"learning_rate": "linear(1e-3, 0)"}}
    for seed in range(5):
        rater = td.SimulatedRater(temperature=1.0)
        found = td.train_on_choices("ppo", "Pendulum-v1", tmp_path / str(seed), simulated=rater, seed=seed, **learner)
        told.append(td.load(found.run).evaluate(100).mean)
        run = td.train("ppo", "Pendulum-v1", seed=seed, output=tmp_path / "true", **learner)
        true.append(td.load(run.run).evaluate(100).mean)
    gains = [(mine + 1208) / (theirs + 1208) for mine, theirs in zip(told, true, strict=True)]
    assert min(gains) >= 0.8, (told, true)
    assert np.mean(true) / np.mean(told) >= 0.8, (told, true)
