"""Reward models: they learn what comparisons say, know when they have not, and come back from their folders."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language import reward_files
from thorndike.language.comparisons import Comparison, Pair, comparison_data, preferred, ranked
from thorndike.language.lora import LoraConfig
from thorndike.language.model import load_decoder
from thorndike.language.reward_files import RewardModel, load_reward_model, normalised, refuse_if_near_chance, save_reward_model
from thorndike.language.reward_model import Config, comparison_loss, rate_by_width, reward_model
from thorndike.language.reward_report import expected_calibration_error, held_out_report
from thorndike.language.reward_training import fit, report_on, scores_of, steps_of_an_epoch
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.usefixtures("quick_compile")
CONFIG, PARAMS = load_decoder(REFERENCE / "llama")
GOOD = 40


def comparison(generator: np.random.Generator, right: bool = True) -> Comparison:
    """A completion with the good token against one without it."""
    prompt, plain = generator.integers(3, 30, 4).tolist(), generator.integers(41, 90, (2, 6)).tolist()
    good = [*plain[0][:3], GOOD, *plain[0][3:]]
    return preferred(prompt, *((good, plain[1]) if right else (plain[1], good)))


def data(number: int, seed: int, flips: bool = False):
    generator = np.random.default_rng(seed)
    return comparison_data([comparison(generator, not flips or generator.random() < 0.5) for _ in range(number)], 0, 12)


@pytest.fixture(scope="module")
def fitted() -> tuple[list, Config]:
    config = Config(total_steps=60, batch_size=16, learning_rate=3e-3, pool="mean")
    return fit(reward_model(config, CONFIG), config, PARAMS, data(256, 0), members=2, seed=1), config


def test_it_learns_what_the_comparisons_say_and_members_differ(fitted):
    members, config = fitted
    held_out = data(128, 9)
    scores = scores_of(members, replace(CONFIG, num_labels=1), held_out, config.pool)
    assert scores.shape == (2, 128, 2) and np.abs(scores[0] - scores[1]).max() > 1e-3
    report = report_on(scores.mean(axis=0), held_out)
    assert report.accuracy > 0.9 and not report.near_chance and report.pairs == 128
    assert report.accuracy_ci95[0] < report.accuracy < report.accuracy_ci95[1]


def test_a_model_of_labels_without_sense_is_refused(fitted):
    members, config = fitted
    nonsense = data(128, 9, flips=True)
    report = report_on(scores_of(members, replace(CONFIG, num_labels=1), nonsense, config.pool).mean(axis=0), nonsense)
    assert report.near_chance
    model = RewardModel(CONFIG, tuple(members), load_tokenizer(REFERENCE / "tokenizer"), "mean", held_out=report)
    with pytest.raises(UserError, match="which guessing explains"):
        refuse_if_near_chance(model)
    refuse_if_near_chance(model._replace(held_out=None))


def test_a_model_comes_back_from_its_folder(fitted, tmp_path: Path):
    members, config = fitted
    held_out = data(64, 3)
    report = report_on(scores_of(members, replace(CONFIG, num_labels=1), held_out, config.pool).mean(axis=0), held_out)
    model = RewardModel(replace(CONFIG, num_labels=1), tuple(members), load_tokenizer(REFERENCE / "tokenizer"), "mean", held_out=report)
    samples = [[int(t) for t in text if t] for text in held_out.tokens[:, 1]]
    model = normalised(model, samples)
    scores = model.score([], [], samples)
    np.testing.assert_allclose([scores.mean(), scores.std()], [0.0, 1.0], atol=1e-6)
    save_reward_model(model, tmp_path / "reward")
    again = load_reward_model(tmp_path / "reward")
    assert again.held_out == report and len(again.members) == 2
    np.testing.assert_allclose(again.all_scores(samples), model.all_scores(samples), atol=1e-5)
    with pytest.raises(UserError, match="without a scalar head"):
        load_reward_model(_language_model(tmp_path))


def _language_model(tmp_path: Path) -> Path:
    from thorndike.language.model import LanguageModel, save_model

    save_model(LanguageModel(CONFIG, PARAMS, load_tokenizer(REFERENCE / "tokenizer")), tmp_path / "plain")
    return tmp_path / "plain"


def test_half_of_a_model_is_never_taken_for_one(fitted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = RewardModel(CONFIG, tuple(fitted[0]), load_tokenizer(REFERENCE / "tokenizer"), "mean")
    with monkeypatch.context() as patch:
        patch.setattr(reward_files, "as_bytes", lambda facts: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            save_reward_model(model, tmp_path / "reward")
    assert not (tmp_path / "reward").exists(), "its members were written, and not what they mean"
    (tmp_path / "reward.partial").mkdir()
    (tmp_path / "reward.partial" / "config.json").write_text("of a process that was killed")
    save_reward_model(model, tmp_path / "reward")
    assert len(load_reward_model(tmp_path / "reward").members) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["reward"]


def test_the_loss_is_that_of_a_loop_over_pairs():
    generator = np.random.default_rng(4)
    batch = comparison_data(
        [
            ranked([5], [[6], [7], [8]]),
            Comparison(((5, 6), (5, 7)), 1, (Pair(1, 0, 0.8, 0.5),)),
            Comparison(((5, 6), (5, 7)), 1, (Pair(0, 1, 0.5),)),
        ],
        0,
    )
    scores = generator.normal(size=(3, 3)).astype(np.float32)
    pairs = [(0, 0, 1, 1.0, 1 / 3), (0, 0, 2, 1.0, 1 / 3), (0, 1, 2, 1.0, 1 / 3), (1, 1, 0, 0.8, 0.5), (2, 0, 1, 0.5, 1.0)]
    total, weights, right = 0.0, 0.0, 0.0
    for row, i, j, p, weight in pairs:
        a, b = float(scores[row, i]), float(scores[row, j])
        p_first = 0.9 * p + 0.1 * (1 - p)
        fit_loss = p_first * np.log1p(np.exp(b - a)) + (1 - p_first) * np.log1p(np.exp(a - b))
        total += weight * (fit_loss + 0.01 * (a + b) ** 2)
        weights += weight
        right += weight * ((a > b) == (p > 0.5)) * (p != 0.5)
    loss, metrics = comparison_loss(jnp.asarray(scores), batch.rows(np.arange(3)), Config(label_smoothing=0.1))
    np.testing.assert_allclose(loss, total / weights, rtol=1e-5)
    np.testing.assert_allclose(metrics["train/accuracy"], right / (weights - 1.0), rtol=1e-5)


@pytest.mark.parametrize("loss", ["bradley_terry", "plackett_luce"])
def test_accumulated_parts_are_the_same_step(loss):
    rankings = [ranked([5, 6], [[7, 8], [9], [10, 11, 12]])] * 2 + [ranked([5, 9], [[8], [9], [7]])] * 2
    batch = comparison_data(rankings, 0).rows(np.arange(4))
    states = []
    for parts in (1, 2):
        learner = reward_model(Config(batch_size=4, gradient_accumulation=parts, loss=loss), CONFIG)
        state = learner.init(PARAMS, jax.random.key(0))
        states.append(jax.jit(learner.update)(state, (), batch))
    np.testing.assert_allclose(states[0][1]["train/loss"], states[1][1]["train/loss"], rtol=1e-4)
    np.testing.assert_allclose(states[0][1]["train/grad_norm"], states[1][1]["train/grad_norm"], rtol=1e-3)


def test_an_adapter_and_the_head_alone_are_learnt():
    config = Config(total_steps=20, batch_size=16, learning_rate=1e-2, pool="mean")
    learner = reward_model(config, CONFIG, LoraConfig(rank=2))
    (found,) = fit(learner, config, PARAMS, data(64, 0))
    np.testing.assert_array_equal(found["embedding"], PARAMS["embedding"])
    assert np.abs(np.asarray(found["layers"][0]["qkv"]["kernel"] - PARAMS["layers"][0]["qkv"]["kernel"])).max() > 1e-4


def test_calibration_and_accuracy_by_gap():
    generator = np.random.default_rng(0)
    gap = generator.normal(size=20_000) * 2
    label = (generator.random(20_000) < 1 / (1 + np.exp(-gap))).astype(np.float32)
    calm, bold = (held_out_report(gap * factor, np.zeros_like(gap), label) for factor in (1.0, 5.0))
    assert calm.calibration_error < 0.02 < 0.1 < bold.calibration_error
    assert [part.accuracy for part in calm.by_gap] == sorted(part.accuracy for part in calm.by_gap)
    assert sum(part.pairs for part in calm.by_gap) == 20_000
    by_hand = 0.0
    confidence, right = np.array([0.52, 0.61, 0.97, 0.99]), np.array([0.0, 1.0, 1.0, 0.0])
    for members in ([0], [1], [2, 3]):
        by_hand += len(members) / 4 * abs(confidence[members].mean() - right[members].mean())
    assert expected_calibration_error(confidence, right) == pytest.approx(by_hand)
    with pytest.raises(UserError, match="all ties"):
        held_out_report(gap, gap, np.full(20_000, 0.5))


def test_mistakes_in_the_data_are_told():
    with pytest.raises(UserError, match="no comparison"):
        comparison_data([], 0)
    with pytest.raises(UserError, match="completion 2 is empty"):
        comparison_data([preferred([5], [6], [])], 0)
    with pytest.raises(UserError, match="more than max_length = 2"):
        comparison_data([preferred([5], [6, 7], [6])], 0, width=2)
    with pytest.raises(UserError, match=r"probability 1\.2"):
        comparison_data([preferred([5], [6], [7], 1.2)], 0)
    with pytest.raises(UserError, match="names texts 0 and 2"):
        comparison_data([Comparison(((5, 6), (5, 7)), 1, (Pair(0, 2),))], 0)
    with pytest.raises(UserError, match="lower it"):
        fit(reward_model(Config(), CONFIG), Config(), PARAMS, data(4, 0))


def test_steps_and_rates():
    assert (steps_of_an_epoch(100, 32), steps_of_an_epoch(100, 32, 3), steps_of_an_epoch(5, 8)) == (3, 9, 1)
    assert rate_by_width(128) == "linear(0.002, 0)" and rate_by_width(512) == "linear(0.00025, 0)"
