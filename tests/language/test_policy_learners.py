"""PPO, GRPO, RLOO and DPO for text against slow loops, and the loop that feeds them: it learns, stops in time and goes on bit for bit."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from language.make_reference import REFERENCE
from thorndike.errors import UserError
from thorndike.language import dpo as direct
from thorndike.language import grpo as groups
from thorndike.language import ppo as proximal
from thorndike.language.comparisons import comparison_data, preferred
from thorndike.language.decoder import hidden_states, logits
from thorndike.language.lora import Adapter, LoraConfig, merged
from thorndike.language.model import LanguageModel, load_decoder, never_ending
from thorndike.language.over_optimisation import Limits, Signals, Watch, repetition, trouble, watched
from thorndike.language.policy_descent import check_ratio
from thorndike.language.policy_files import Progress, load_progress, save_progress
from thorndike.language.policy_training import Task, train_policy
from thorndike.language.rewards import checked_scores, weighted_sum
from thorndike.language.rollouts import Prompts, as_written, choose_prompts, distance, distance_metrics, sample_rollout
from thorndike.language.text_run import open_run
from thorndike.language.tokenizer import load_tokenizer

pytestmark = pytest.mark.usefixtures("quick_compile")
CONFIG, PARAMS = load_decoder(REFERENCE / "llama")
TOKENIZER = load_tokenizer(REFERENCE / "tokenizer")
GENERATOR = np.random.default_rng(0)
P, N, B = 5, 6, 16
STOP, GOOD = 7, 40
LENGTHS = [5, 3, 1, 4]
PROMPTS = Prompts(
    np.stack([np.r_[np.zeros(P - n), GENERATOR.integers(10, 90, n)] for n in LENGTHS]).astype(np.int32),
    np.stack([np.r_[np.zeros(P - n), np.ones(n)] for n in LENGTHS]).astype(np.int32),
    ("a", "b", "c", "d"),
)
SMALL = {"episodes": B, "batch_size": 8, "max_new_tokens": N, "max_prompt_length": P, "n_epochs": 2, "learning_rate": 3e-3}
# The reference models know 96 tokens: byte-level text of any of them can be written.
BASE = LanguageModel(replace(CONFIG, eos_token_ids=(STOP,)), PARAMS, TOKENIZER)


def by_token(prompts, completions, ids) -> list[float]:
    """Likes one token."""
    return [float(GOOD in row) for row in ids]


@pytest.fixture(scope="module")
def texts():
    """Texts of the base, and how far another policy is from it."""
    rows = np.arange(4).repeat(4)
    rollout = sample_rollout(
        PARAMS, CONFIG, PROMPTS, rows, jax.random.key(1), max_new_tokens=N, temperature=0.7, stop_tokens=(STOP, 30, 31, 32), pad_id=0
    )
    other = jax.tree.map(lambda leaf: leaf * 1.3, PARAMS)
    return rollout, distance(other, PARAMS, CONFIG, rollout, 0.7), other


def test_distances_are_those_of_whole_distributions_at_the_temperature(texts):
    rollout, found, other = texts
    assert 0 < int(rollout.ended.sum()) < B
    every = [
        np.asarray(jax.nn.log_softmax(logits(params, CONFIG, hidden_states(params, CONFIG, rollout.tokens, rollout.segments)) / 0.7))
        for params in (other, PARAMS)
    ]
    for row in range(B):
        for t in range(N):
            ours, theirs = (each[row, P + t - 1] for each in every)
            token, there = int(rollout.tokens[row, P + t]), bool(rollout.valid[row, t])
            wanted = (ours[token], theirs[token], float((np.exp(ours) * (ours - theirs)).sum())) if there else (0, 0, 0)
            for part, value in zip(found, wanted, strict=True):
                assert float(part[row, t]) == pytest.approx(value, abs=2e-5)
            if there:
                assert float(rollout.log_probs[row, t]) == pytest.approx(theirs[token], abs=1e-5)
    assert (found.exact_kl >= 0).all()


def test_the_estimators_surround_the_exact_divergence():
    rows = np.zeros(512, int)
    other = jax.tree.map(lambda leaf: leaf * 1.1, PARAMS)
    rollout = sample_rollout(other, CONFIG, PROMPTS, rows, jax.random.key(2), max_new_tokens=N, temperature=1.0, stop_tokens=(), pad_id=0)
    found = distance(other, PARAMS, CONFIG, rollout, 1.0)
    metrics = distance_metrics(rollout, found)
    error = np.asarray(jnp.sum(found.log_probs - found.reference_log_probs - found.exact_kl, axis=1))
    assert abs(error.mean()) < 3 * error.std() / len(error) ** 0.5
    assert float(metrics["objective/kl"]) > 0.01 and float(metrics["train/log_prob_gap"]) < 1e-4
    assert float(metrics["objective/kl_k3"]) > 0


def test_what_is_scored_ends_at_the_first_stop(texts):
    written = as_written(texts[0], TOKENIZER)
    for row in range(B):
        completion = written.ids[row][LENGTHS[row // 4] :]
        assert len(completion) == written.lengths[row] <= N
        stops = [token in (STOP, 30, 31, 32) for token in completion]
        assert not any(stops[:-1]) and stops[-1] == bool(written.ended[row])
        assert written.completions[row] == TOKENIZER.decode(completion)


def test_advantages_of_ppo_are_those_of_a_loop(texts):
    rollout, found, _ = texts
    value, score = GENERATOR.normal(size=(B, N)).astype(np.float32), GENERATOR.normal(size=B).astype(np.float32)
    config = proximal.Config(**SMALL, gamma=0.9, gae_lambda=0.8)
    batch = proximal.advantages(rollout, found, jnp.asarray(value), jnp.asarray(score), jnp.float32(0.2), config)
    advantage, target = np.zeros((B, N)), np.zeros((B, N))
    lengths = np.asarray(rollout.valid.sum(axis=1))
    for row in range(B):
        following = 0.0
        for t in reversed(range(int(lengths[row]))):
            reward = -0.2 * float(found.log_probs[row, t] - found.reference_log_probs[row, t])
            last = t == lengths[row] - 1
            reward += score[row] if last else 0.0
            delta = reward + (0.0 if last else 0.9 * value[row, t + 1]) - value[row, t]
            following = delta + 0.9 * 0.8 * following
            advantage[row, t], target[row, t] = following, following + value[row, t]
    kept = np.asarray(rollout.valid)
    np.testing.assert_allclose(np.asarray(batch.target)[kept], target[kept], atol=1e-4)
    wanted = (advantage - advantage[kept].mean()) / advantage[kept].std()
    np.testing.assert_allclose(np.asarray(batch.advantage), np.where(kept, wanted, 0.0), atol=1e-4)


@pytest.mark.parametrize("baseline", ["group", "leave_one_out"])
def test_advantages_of_groups(texts, baseline):
    _, found, _ = texts
    score = GENERATOR.normal(size=B).astype(np.float32)
    config = groups.Config(**SMALL, group=4, baseline=baseline)
    advantage = groups.text_advantages(jnp.asarray(score), found, jnp.float32(0.3), config)
    log_ratio = np.asarray(jnp.sum(found.log_probs - found.reference_log_probs, axis=1))
    reward = score - 0.3 * log_ratio if baseline == "leave_one_out" else score
    for row in range(B):
        others = [i for i in range(B) if i // 4 == row // 4]
        if baseline == "group":
            wanted = (reward[row] - reward[others].mean()) / (reward[others].std(ddof=1) + 1e-4)
        else:
            wanted = reward[row] - np.mean([reward[i] for i in others if i != row])
        assert float(advantage[row]) == pytest.approx(wanted, abs=1e-4)


LEARNERS = {
    "separate": lambda: proximal.ppo(proximal.Config(**SMALL, total_steps=8, temperature=0.8), BASE.config, PARAMS),
    "shared": lambda: proximal.ppo(proximal.Config(**SMALL, total_steps=8, temperature=0.8, value="shared"), BASE.config, PARAMS),
    "grpo": lambda: groups.grpo(groups.Config(**SMALL, total_steps=8, temperature=0.8, group=4), BASE.config, PARAMS),
    "rloo": lambda: groups.grpo(
        groups.Config(**SMALL, total_steps=8, temperature=0.8, group=4, baseline="leave_one_out"), BASE.config, PARAMS
    ),
    "lora": lambda: groups.grpo(groups.Config(**SMALL, total_steps=8, temperature=0.8, group=4), BASE.config, PARAMS, LoraConfig(rank=4)),
}


def loop_config(name: str):
    if name in ("separate", "shared"):
        return proximal.Config(**SMALL, total_steps=8, temperature=0.8)
    return groups.Config(**SMALL, total_steps=8, temperature=0.8, group=4)


def start(tmp_path: Path, name: str) -> Path:
    open_run(tmp_path / name, {"learner": name})
    return tmp_path / name


FREE = Limits(None, None, None, None)


@pytest.mark.parametrize("name", LEARNERS)
def test_a_policy_learns_what_is_rewarded(name, tmp_path):
    run, seen = start(tmp_path, name), []
    outcome = train_policy(
        Task(BASE, PROMPTS, by_token), LEARNERS[name](), loop_config(name), run, limits=FREE, told=lambda step, values: seen.append(values)
    )
    assert outcome.iterations == 8 and outcome.finished and outcome.stopped is None and outcome.kl > 0.05
    assert all(values["train/first_ratio_error"] < 1e-4 and values["train/log_prob_gap"] < 1e-4 for values in seen)
    assert seen[0]["objective/kl"] == pytest.approx(0.0, abs=1e-5)
    assert np.mean([values["objective/score"] for values in seen[-3:]]) > np.mean([values["objective/score"] for values in seen[:2]])
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["steps"] for line in lines] == list(range(1, 9)) and list(run.glob("events.out.tfevents.*"))


@pytest.mark.parametrize("name", ["separate", "grpo"])
def test_texts_that_never_end_are_learnt_from_as_they_were_sampled(name, tmp_path):
    endless, config = never_ending(BASE), replace(loop_config(name), total_steps=3, learning_rate=3e-2, ignore_eos=True)
    built = proximal.ppo(config, endless.config, PARAMS) if name == "separate" else groups.grpo(config, endless.config, PARAMS)
    run, seen, rows = start(tmp_path, name), [], []

    def score(prompts, completions, ids):
        rows.extend(ids)
        return by_token(prompts, completions, ids)

    outcome = train_policy(Task(endless, PROMPTS, score), built, config, run, limits=FREE, told=lambda step, values: seen.append(values))
    assert all(values["rollout/ep_len_mean"] == N and values["rollout/ended"] == 0.0 for values in seen)
    assert all(values["train/first_ratio_error"] < 1e-4 and values["train/log_prob_gap"] < 1e-4 for values in seen)
    assert (
        not any(STOP in row[-N:] for row in rows) and outcome.kl > 0.01 and all(np.isfinite(list(values.values())).all() for values in seen)
    )


def numbers(run: Path) -> list[dict]:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "wall_s"} for line in lines]


def test_it_goes_on_bit_for_bit(tmp_path):
    config, task = proximal.Config(**SMALL, total_steps=6), Task(BASE, PROMPTS, by_token)
    learner = proximal.ppo(config, BASE.config, PARAMS)
    whole, cut = start(tmp_path, "whole"), start(tmp_path, "cut")
    straight = train_policy(task, learner, config, whole, limits=FREE)
    assert not train_policy(task, learner, config, cut, limits=FREE, until=3).finished
    resumed = train_policy(task, learner, config, cut, limits=FREE)
    assert numbers(whole) == numbers(cut)
    jax.tree.map(np.testing.assert_array_equal, straight.params, resumed.params)
    assert json.loads((cut / "outcome.json").read_text())["status"] == "finished"


def test_the_adapter_that_is_kept_is_that_of_the_parameters_that_are_kept(tmp_path):
    config, lora = groups.Config(**(SMALL | {"learning_rate": 0.01}), total_steps=30, group=4, kl_coefficient=0.0), LoraConfig(2, 4.0)
    learner, task, run = groups.grpo(config, BASE.config, PARAMS, lora), Task(BASE, PROMPTS, by_token), start(tmp_path, "adapted")
    limits = Limits(0.3, None, None, None)
    assert not train_policy(task, learner, config, run, limits=limits, until=2).finished
    outcome = train_policy(task, learner, config, run, limits=limits)
    assert outcome.stopped is not None and 2 <= outcome.iterations < 30
    jax.tree.map(np.testing.assert_array_equal, outcome.params, merged(PARAMS, CONFIG, Adapter(lora, outcome.adapter)))
    again = train_policy(task, learner, config, run, limits=limits)
    jax.tree.map(np.testing.assert_array_equal, again.adapter, outcome.adapter)
    assert outcome.kl > 0


def test_checkpoints_of_older_versions_have_no_adapter(tmp_path):
    tree, adapter, progress = {"a": jnp.ones(2)}, {"q": jnp.arange(3.0)}, Progress(4, Watch(), 1.0)
    for name, saved in {"old": None, "new": adapter}.items():
        run = start(tmp_path, name)
        save_progress(run, tree, progress, saved)
        found = load_progress(run, tree, adapter)
        assert found[1] == progress and (found[2] is None) == (saved is None)
    np.testing.assert_array_equal(found[2]["q"], adapter["q"])


def test_beyond_the_limit_the_last_parameters_within_it_are_kept(tmp_path):
    config, seen = proximal.Config(**SMALL, total_steps=30, kl_coefficient=0.0, target_kl=None), []
    learner, run = proximal.ppo(config, BASE.config, PARAMS), start(tmp_path, "limited")
    outcome = train_policy(
        Task(BASE, PROMPTS, by_token), learner, config, run, limits=Limits(max_kl=0.3), told=lambda step, values: seen.append(values)
    )
    assert outcome.stopped is not None and "max_kl = 0.3" in outcome.stopped and outcome.iterations < 30
    assert outcome.kl == pytest.approx(seen[-1]["objective/kl"], rel=1e-5) and outcome.kl <= 0.3
    assert "max_kl" in json.loads((run / "outcome.json").read_text())["why"]


def test_signs_of_over_optimisation():
    limits = Limits(max_kl=20.0)
    watch = watched(Watch(), Signals(0.0, 0.05, 24.0, 0.5))
    assert watch == Watch(0.05, 24.0, None)
    watch = watched(watch, Signals(1.2, 0.06, 24.0, 0.6))
    assert watch.disagreement == 0.6 and watched(watch, Signals(3.0, 0.0, 9.0, 9.0)) == watch
    fine = Signals(6.0, 0.1, 20.0, 0.9)
    assert trouble(limits, watch, fine) is None
    for change, words in [
        ({"kl": 20.5}, "max_kl"), ({"disagreement": 1.3}, "disagree 2.2 times"),
        ({"repetition": 0.31}, "repetition"), ({"length": 7.0}, "7 tokens"),
        ({"length": 80.0}, "80 tokens"),
    ]:  # fmt: skip
        assert words in (trouble(limits, watch, fine._replace(**change)) or "")
    assert trouble(FREE, watch, Signals(90.0, 1.0, 900.0, 9.0)) is None
    assert repetition("abab") == pytest.approx(1 / 3) and repetition("a") == 0.0 and repetition("abcd") == 0.0


def test_an_untrue_ratio_is_a_fault():
    check_ratio({"train/first_ratio_error": jnp.float32(1e-5)}, "float32")
    with pytest.raises(RuntimeError, match="temperature, padding"):
        check_ratio({"train/first_ratio_error": jnp.float32(0.05)}, "float32")
    with pytest.raises(RuntimeError, match="off 1 by nan"):
        check_ratio({"train/first_ratio_error": jnp.float32(np.nan)}, "float32")


def test_prompts_are_all_answered_before_any_is_again():
    rows = choose_prompts(PROMPTS, jax.random.key(3), 10)
    assert sorted(rows[:4].tolist()) == sorted(rows[4:8].tolist()) == [0, 1, 2, 3]


def test_rewards_are_checked_and_summed():
    score = weighted_sum([(2.0, by_token), (-1.0, lambda prompts, completions, ids: [len(row) for row in ids])])
    np.testing.assert_array_equal(checked_scores(score, ["", ""], ["", ""], [[GOOD, 1], [1]]), [0.0, -1.0])
    for wrong, words in [([1.0], "shape"), ([1.0, np.nan], "is nan"), (None, "a number a text"), (["x", "y"], "a number a text")]:
        with pytest.raises(UserError, match=words):
            checked_scores(lambda prompts, completions, ids, answer=wrong: answer, ["", ""], ["a", "b"], [[1], [2]])


def test_dpo_is_the_loss_of_sums_over_completions():
    pairs = [preferred([5, 6], [7, 8], [9], 0.8), preferred([5], [9, 10, 11], [12, 13], 1.0, 0.5)]
    data, other = comparison_data(pairs, 0), jax.tree.map(lambda leaf: leaf * 1.2, PARAMS)
    reference, ours = (direct.reference_log_probs(params, CONFIG, data) for params in (PARAMS, other))
    for row, pair in enumerate(pairs):
        for place, text in enumerate(pair.texts):
            log_p = jax.nn.log_softmax(logits(PARAMS, CONFIG, hidden_states(PARAMS, CONFIG, jnp.asarray([text]))))[0]
            wanted = sum(float(log_p[t - 1, text[t]]) for t in range(pair.prompt_length, len(text)))
            assert float(reference[row, place]) == pytest.approx(wanted, abs=1e-4)
    batch = direct.Batch(data.rows(np.arange(2)), jnp.asarray(reference))
    loss, metrics = direct.preference_loss(jnp.asarray(ours), batch, direct.Config(beta=0.5))
    margin = (ours - reference)[:, 0] - (ours - reference)[:, 1]
    one, other_way = np.log1p(np.exp(-0.5 * margin)), np.log1p(np.exp(0.5 * margin))
    assert float(loss) == pytest.approx((0.8 * one[0] + 0.2 * other_way[0] + 0.5 * one[1]) / 1.5, rel=1e-4)
    assert float(metrics["train/reward_margin"]) == pytest.approx(0.5 * (margin[0] + 0.5 * margin[1]) / 1.5, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("loss", ["sigmoid", "robust", "ipo"])
def test_dpo_makes_the_better_one_likelier(loss):
    config = direct.Config(total_steps=20, learning_rate=1e-3, loss=loss, label_smoothing=0.0 if loss == "ipo" else 0.05)
    data = comparison_data([preferred([5, 6], [7, 8], [9, 10]), preferred([11], [12], [13, 14])], 0)
    learner = direct.dpo(config, CONFIG)
    batch = direct.Batch(data.rows(np.arange(2)), jnp.asarray(direct.reference_log_probs(PARAMS, CONFIG, data)))
    state, update = learner.init(PARAMS, jax.random.key(0)), jax.jit(learner.update)
    first = None
    for _ in range(20):
        state, metrics = update(state, (), batch)
        first = first or metrics
    assert float(first["train/reward_margin"]) == pytest.approx(0.0, abs=1e-4)
    assert float(metrics["train/loss"]) < float(first["train/loss"]) and float(metrics["train/accuracy"]) == 1.0


@pytest.mark.parametrize(
    ("config", "wrong", "words"),
    [
        (proximal.Config, {"batch_size": 48}, "do not divide into minibatches"),
        (proximal.Config, {"temperature": 0.0}, "temperature"),
        (proximal.Config, {"ignore_eos": True, "missing_eos_penalty": 1.0}, "would charge all of them"),
        (groups.Config, {"ignore_eos": True, "missing_eos_penalty": 1.0}, "would charge all of them"),
        (groups.Config, {"group": 5}, "groups of 5"),
        (groups.Config, {"gradient_accumulation": 5}, "parts"),
        (direct.Config, {"loss": "ipo", "label_smoothing": 0.1}, "takes no label_smoothing"),
        (direct.Config, {"label_smoothing": 0.5}, "label_smoothing"),
    ],
)
def test_settings_that_do_not_fit_are_refused(config, wrong, words):
    with pytest.raises(UserError, match=words):
        config(**wrong)
