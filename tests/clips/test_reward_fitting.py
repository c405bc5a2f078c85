"""A reward from choices: a known one is found again, what says nothing is called so, short clips keep its level."""

from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces

from thorndike.clips.queries import disagreement, pairs_to_ask, random_pairs
from thorndike.clips.reward_fitting import Config, fit_reward, predicted_returns
from thorndike.clips.segments import Choices, Row, Segments, segment, together
from thorndike.environments.learned_reward import raw_rewards
from thorndike.errors import UserError

OBS, ACT = spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-1, 1, (2,), np.float32)
CONFIG = Config(total_steps=400, net_arch=(32,), error_rate=0.0)
CLIPS, LENGTH = 80, 6


def linear(obs, action):
    """The reward that choices are made by."""
    return 2.0 * obs[..., 0] - obs[..., 2] + 0.5 * action[..., 1]


def clips_of(seed, clips=CLIPS):
    dice = np.random.default_rng(seed)
    obs = dice.normal(1.0, 2.0, (clips, LENGTH, 3)).astype(np.float32)
    action = dice.uniform(-1, 1, (clips, LENGTH, 2)).astype(np.float32)
    return Segments((obs,), action, linear(obs, action).astype(np.float32), np.ones((clips, LENGTH), bool))


def choices_by(worth, seed, count=300):
    pairs = random_pairs(len(worth), count, np.random.default_rng(seed))
    return Choices(pairs[:, 0], pairs[:, 1], (worth[pairs[:, 0]] > worth[pairs[:, 1]]).astype(np.float32))


@pytest.fixture(scope="module")
def linear_fit():
    clips = clips_of(0)
    return fit_reward(clips, choices_by(clips.returns, 1), (OBS, ACT), CONFIG)


def test_a_linear_reward_is_found_again_on_clips_that_nobody_judged(linear_fit):
    held, report = linear_fit
    fresh = clips_of(7)
    told = predicted_returns(held, fresh, CONFIG.net_arch)
    assert told.shape == (3, CLIPS)
    for member in told:
        assert np.corrcoef(member, fresh.returns)[0, 1] > 0.9
    obs, action = fresh.obs[0].reshape(-1, 3), fresh.action.reshape(-1, 2)
    steps = np.asarray(raw_rewards(held, (obs,), action, CONFIG.net_arch)).mean(0)
    assert np.corrcoef(steps, linear(obs, action))[0, 1] > 0.9
    assert report.accuracy > 0.85 and report.accuracy_ci95[0] > 0.75 and not report.near_chance
    # A bootstrap leaves out 1/e; three of them together leave few choices that nobody left out.
    assert 0.6 < report.held_out / report.choices < 0.9


def test_members_are_brought_to_level_0_and_spread_1(linear_fit):
    held, _ = linear_fit
    clips = clips_of(0)
    raw = np.asarray(raw_rewards(held, (clips.obs[0].reshape(-1, 3),), clips.action.reshape(-1, 2), CONFIG.net_arch))
    normal = (raw - np.asarray(held.level)[:, None]) / np.asarray(held.spread)[:, None]
    np.testing.assert_allclose(normal.mean(1), 0.0, atol=1e-4)
    np.testing.assert_allclose(normal.std(1), 1.0, atol=1e-3)


def test_the_same_choices_and_seed_give_the_same_reward():
    clips = clips_of(0, 20)
    config = Config(total_steps=50, net_arch=(8,), members=2)
    choices = choices_by(clips.returns, 1, 40)
    fits = [fit_reward(clips, choices, (OBS, ACT), config, seed)[0] for seed in (3, 3, 4)]
    np.testing.assert_array_equal(fits[0].params, fits[1].params)
    assert not np.array_equal(fits[0].params, fits[2].params)
    assert not np.array_equal(fits[0].params[0], fits[0].params[1]), "members differ"


def test_choices_without_sense_are_near_chance_and_raise_the_penalty():
    clips = clips_of(0)
    dice, choices = np.random.default_rng(6), choices_by(clips.returns, 1)
    choices = choices._replace(p_first=dice.integers(0, 2, choices.number).astype(np.float32))
    # A loss on held-out choices above that on the others makes the penalty larger, by half in each of eight stretches.
    _, report = fit_reward(clips, choices, (OBS, ACT), replace(CONFIG, held_out_from=1.0, held_out_to=1.0))
    assert report.near_chance
    np.testing.assert_allclose(report.l2, CONFIG.l2 * 1.5**8, rtol=1e-4)


def test_where_clips_end_early_the_level_of_the_reward_is_kept():
    """Every step is worth the same: longer clips are better, which only the level of the reward can say."""
    dice = np.random.default_rng(0)

    def clip(length):
        rows = [Row((dice.normal(size=3).astype(np.float32),), dice.uniform(-1, 1, 2).astype(np.float32), 1.0) for _ in range(length)]
        return segment(rows, LENGTH)

    clips = together([clip(1 + number % LENGTH) for number in range(CLIPS)])
    assert not clips.all_whole and clips.returns.tolist()[:7] == [1, 2, 3, 4, 5, 6, 1]
    held, report = fit_reward(clips, choices_by(clips.returns, 1), (OBS, ACT), CONFIG)
    assert np.all(np.asarray(held.level) == 0) and report.accuracy > 0.8
    raw = np.asarray(raw_rewards(held, (dice.normal(size=(50, 3)).astype(np.float32),), np.zeros((50, 2), np.float32), CONFIG.net_arch))
    assert np.mean(raw > 0) > 0.9


@pytest.mark.parametrize(
    ("observation", "obs", "actions", "action"),
    [
        (spaces.Discrete(5), np.int32(3), spaces.Discrete(3), np.int32(2)),
        (spaces.Box(0, 255, (8, 8, 1), np.uint8), np.ones((8, 8, 1), np.uint8), spaces.MultiDiscrete([2, 3]), np.array([1, 2])),
    ],
    ids=["numbers", "pictures"],
)
def test_other_spaces(observation, obs, actions, action):
    clips = together([segment([Row((np.asarray(obs),), np.asarray(action), float(n))] * 2, 3) for n in range(4)])
    choices = Choices(np.array([0, 1, 2]), np.array([1, 2, 3]), np.zeros(3, np.float32))
    held, _ = fit_reward(clips, choices, (observation, actions), Config(total_steps=1, net_arch=(4,), members=2, batch_size=2))
    assert predicted_returns(held, clips, (4,)).shape == (2, 4) and np.isfinite(held.params).all()


def test_too_few_choices_are_one_line():
    clips = clips_of(0, 4)
    with pytest.raises(UserError, match="1 choices are too few"):
        fit_reward(clips, choices_by(clips.returns, 1, 1), (OBS, ACT), CONFIG)


# which pairs to ask


def test_disagreement_is_the_deviation_of_the_members_probabilities():
    sums, pairs = np.random.default_rng(0).normal(size=(3, 9)), np.array([[0, 1], [4, 2], [8, 3]])
    wanted = []
    for first, second in pairs:
        chances = [1 / (1 + np.exp(member[second] - member[first])) for member in sums]
        wanted.append(np.sqrt(sum((each - sum(chances) / 3) ** 2 for each in chances) / 3))
    np.testing.assert_allclose(disagreement(sums, pairs), wanted, rtol=1e-6)


def test_pairs_are_different_and_those_with_most_disagreement_are_asked():
    dice = np.random.default_rng(0)
    pairs = pairs_to_ask(6, 100, dice)
    assert len(pairs) == 15 == len({frozenset(pair) for pair in pairs.tolist()}) and (pairs[:, 0] != pairs[:, 1]).all()
    # Members agree on all clips but the last.
    sums = np.zeros((2, 12))
    sums[:, 11] = [5.0, -5.0]
    asked = pairs_to_ask(12, 8, dice, sums)
    assert all(11 in pair for pair in asked.tolist())
