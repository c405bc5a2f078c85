"""From folders and files to aligned models: what the verbs ``reward``, ``ppo``, ``grpo``, ``rloo``, ``dpo`` and ``eval`` do."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.errors import UserError
from thorndike.language import dpo as direct
from thorndike.language import grpo as groups
from thorndike.language import ppo as proximal
from thorndike.language.best_of_n import best, sample_many
from thorndike.language.comparisons import ComparisonData, comparison_data
from thorndike.language.data import prompts_tokens
from thorndike.language.json_fields import Dtype
from thorndike.language.learner import State
from thorndike.language.lora import Adapter, LoraConfig, save_adapter
from thorndike.language.model import LanguageModel, computing_in, load_model, never_ending, precision, save_model
from thorndike.language.over_optimisation import Limits
from thorndike.language.policy_learner import PolicyLearner
from thorndike.language.policy_training import Outcome, Task, Told, train_policy
from thorndike.language.preference_files import read_comparisons, read_prompts
from thorndike.language.reward_files import RewardModel, load_reward_model, normalised, refuse_if_near_chance, save_reward_model
from thorndike.language.reward_model import Config as RewardConfig
from thorndike.language.reward_model import reward_model
from thorndike.language.reward_report import HeldOut
from thorndike.language.reward_training import as_one, passes, report_on, scores_of
from thorndike.language.rewards import Score, function_score, model_score, weighted_sum
from thorndike.language.rollouts import Written, make_prompts
from thorndike.language.text_run import ADAPTER, MODEL, TextOutcome, TextPlan, open_run, run_learner
from thorndike.language.win_rate import Comparison, compare_with_base
from thorndike.settings import settings_of
from thorndike.training.run_directory import write_json
from thorndike.user_code import attribute_in_file, import_module, load_file

Config = TypeVar("Config")
CLIP = 5.0
"""Deviations beyond which a reward model is not believed."""


class Reward(NamedTuple):
    """A part of the reward, as it was asked for."""

    weight: float
    what: str
    """A reward model's folder, ``module:function`` or ``file.py:function``."""


class Rewards(NamedTuple):
    """The whole of it."""

    score: Score
    models: tuple[RewardModel, ...]


def parse_reward(text: str) -> Reward:
    """``WHAT``, or ``WEIGHT*WHAT``. Raises ``UserError`` for a weight that is no number."""
    weight, star, what = text.rpartition("*")
    try:
        return Reward(float(weight) if star else 1.0, what)
    except ValueError:
        raise UserError(f"a reward is WHAT or WEIGHT*WHAT, such as 0.5*runs/reward/model; got '{text}'") from None


def _named(part: Reward) -> str:
    """What was asked for, in the words of ``parse_reward``."""
    return part.what if part.weight == 1.0 else f"{part.weight}*{part.what}"


def load_rewards(parts: Sequence[Reward], base: LanguageModel) -> Rewards:
    """The sum of the parts. Raises ``UserError`` for what is neither a model nor a function, and for models that are near chance."""
    scores, models = [], []
    for part in parts:
        if Path(part.what).is_dir():
            model = load_reward_model(part.what)
            refuse_if_near_chance(model)
            if model.tokenizer.files.get("tokenizer.json") != base.tokenizer.files.get("tokenizer.json"):
                raise UserError(f"{part.what} has another tokenizer than the model to train: make the reward model from that model")
            models.append(model)
            scores.append((part.weight, model_score(model, CLIP)))
        else:
            scores.append((part.weight, _function(part.what)))
    return Rewards(scores[0][1] if len(scores) == 1 and scores[0][0] == 1.0 else weighted_sum(scores), tuple(models))


def train_reward_model(
    folder: Path, data: Sequence[Path], held_out: Sequence[Path], out: Path, settings: Mapping[str, object], *, members: int = 1,
    seed: int = 0, lora: LoraConfig | None = None, dtype: Dtype | None = None, progress: bool = True,
) -> HeldOut | None:  # fmt: skip
    """A reward model from files of preferences, in ``out/model``. Without ``held_out`` a tenth of them is kept to measure with.

    Goes on where it stopped; nothing is found if it is interrupted.
    """
    plain = load_model(folder)
    base = computing_in(plain, dtype)
    comparisons = read_comparisons(data, base.tokenizer)
    measured = read_comparisons(held_out, base.tokenizer) if held_out else []
    if not measured:
        order = np.random.default_rng([seed, 10]).permutation(len(comparisons))
        share = max(1, len(comparisons) // 10)
        measured = [comparisons[row] for row in order[:share]]
        comparisons = [comparisons[row] for row in order[share:]]
    train, test = (comparison_data(each, base.tokenizer.pad_id) for each in (comparisons, measured))
    size = min(int(cast(int, settings.get("batch_size", 32))), max(1, len(train.valid)))
    config = configured(RewardConfig, {"total_steps": max(1, len(train.valid) // size), **settings, "batch_size": size})
    request = {"verb": "reward", "model": str(folder.absolute()), "data": [str(path.absolute()) for path in data], "members": members}
    request |= {"held_out": [str(path.absolute()) for path in held_out], "seed": seed, "settings": settings_of(config)}
    open_run(out, request | precision(dtype) | ({} if lora is None else {"lora": settings_of(lora)}), [*data, *held_out])
    if (out / MODEL).exists():
        return cast(HeldOut, load_reward_model(out / MODEL).held_out)
    learner = as_one(reward_model(config, base.config, lora), members)
    plan = TextPlan(config.total_steps, log_every=max(1, config.total_steps // 100), checkpoint_every=max(1, config.total_steps // 5))
    outcome = run_learner(out, learner, base.params, passes(train, config, members, seed), plan, seed, progress=progress)
    if outcome.status != "finished":
        return None
    learnt = learner.params(outcome.state, base.params)
    scored = replace(plain.config, num_labels=1)
    found = report_on(scores_of(learnt, scored, test, config.pool).mean(axis=0), test)
    model = RewardModel(scored, tuple(learnt), base.tokenizer, config.pool, held_out=found)
    save_reward_model(normalised(model, _base_samples(base, train, seed)), out / MODEL)
    write_json(
        out / "outcome.json", {**found._asdict(), "by_gap": [each._asdict() for each in found.by_gap], "near_chance": found.near_chance}
    )
    return found


def align(
    folder: Path, rewards: Sequence[Reward], prompts: Sequence[Path], out: Path, learner: str, settings: Mapping[str, object], *,
    limits: Limits, lora: LoraConfig | None = None, seed: int = 0, dtype: Dtype | None = None, told: Told | None = None,
) -> tuple[Outcome, Comparison | None]:  # fmt: skip
    """PPO, GRPO or RLOO into ``out``; its ``model`` is a Hugging Face folder. Goes on where it stopped; no comparison if interrupted.

    A tenth of the prompts (at most 256) is kept to compare with the base on, in ``comparison.json`` with samples of both.
    """
    config: proximal.Config | groups.Config
    if learner == "ppo":
        config = configured(proximal.Config, settings)
    else:
        config = configured(groups.Config, {**settings, **({"baseline": "leave_one_out"} if learner == "rloo" else {})})
    plain = load_model(folder)
    plain = never_ending(plain) if config.ignore_eos else plain
    base = computing_in(plain, dtype)
    reward = load_rewards(rewards, base)
    built: PolicyLearner
    if isinstance(config, proximal.Config):
        built = proximal.ppo(config, base.config, base.params, _value_params(reward, base), lora)
    else:
        built = groups.grpo(config, base.config, base.params, lora)
    texts = read_prompts(prompts)
    kept = min(256, len(texts) // 10) or 1
    train, held_out = (make_prompts(part, base.tokenizer, config.max_prompt_length) for part in (texts[:-kept] or texts, texts[-kept:]))
    open_run(out, {
        "verb": learner, "model": str(folder.absolute()), "rewards": [list(each) for each in rewards], "seed": seed,
        "prompts": [str(path.absolute()) for path in prompts], "settings": settings_of(config), "limits": settings_of(limits),
        "lora": None if lora is None else settings_of(lora), **precision(dtype),
    }, prompts)  # fmt: skip
    task = Task(base, train, reward.score, _members(reward))
    outcome = train_policy(task, built, config, out, seed=seed, limits=limits, told=told)
    if not outcome.finished:
        return outcome, None
    found = compare_with_base(
        base,
        outcome.params,
        held_out,
        {"reward": reward.score},
        max_new_tokens=config.max_new_tokens,
        temperature=config.temperature,
        seed=seed,
    )
    write_json(out / "comparison.json", as_json(found))
    if not (out / MODEL).exists():
        if lora is not None and outcome.adapter is not None:
            save_adapter(Adapter(lora, outcome.adapter), plain.config, out / ADAPTER, str(folder.absolute()))
        save_model(plain._replace(params=outcome.params), out / MODEL)
    return outcome, found


def align_by_preferences(
    folder: Path, data: Sequence[Path], out: Path, settings: Mapping[str, object], *, lora: LoraConfig | None = None, seed: int = 0,
    dtype: Dtype | None = None, progress: bool = True,
) -> TextOutcome:  # fmt: skip
    """DPO into ``out``; its ``model`` is a Hugging Face folder. Goes on where it stopped."""
    plain = load_model(folder)
    base = computing_in(plain, dtype)
    comparisons = comparison_data(read_comparisons(data, base.tokenizer), base.tokenizer.pad_id)
    rows = len(comparisons.valid)
    size = min(int(cast(int, settings.get("batch_size", 32))), rows)
    config = configured(direct.Config, {"total_steps": max(1, rows // size), **settings, "batch_size": size})
    open_run(out, {
        "verb": "dpo", "model": str(folder.absolute()), "data": [str(path.absolute()) for path in data], "seed": seed,
        "settings": settings_of(config), "lora": None if lora is None else settings_of(lora), **precision(dtype),
    }, data)  # fmt: skip
    reference = direct.reference_log_probs(base.params, base.config, comparisons)
    learner, per_pass = direct.dpo(config, base.config, lora), rows // size

    def batch(step: int, state: State) -> direct.Batch:
        order = np.random.default_rng([seed, step // per_pass]).permutation(rows)
        chosen = order[step % per_pass * size : (step % per_pass + 1) * size]
        return direct.Batch(comparisons.rows(chosen), jnp.asarray(reference[chosen]))

    plan = TextPlan(config.total_steps, log_every=max(1, config.total_steps // 100), checkpoint_every=max(1, config.total_steps // 5))
    outcome = run_learner(out, learner, base.params, batch, plan, seed, progress=progress)
    if outcome.status == "finished" and not (out / MODEL).exists():
        if lora is not None:
            save_adapter(Adapter(lora, outcome.state.trained), plain.config, out / ADAPTER, str(folder.absolute()))
        save_model(plain._replace(params=learner.params(outcome.state, learner.frozen(base.params))), out / MODEL)
    return outcome


def compare_folders(
    base: Path, policy: Path, prompts: Sequence[Path], scores: Sequence[Reward], *, max_new_tokens: int, temperature: float, seed: int,
    ignore_eos: bool = False,
) -> Comparison:  # fmt: skip
    """A policy beside its base, by every score on its own; with ``ignore_eos`` no text of either ends before its limit.

    Raises ``UserError`` if they are not of one shape.
    """
    first, second = load_model(base), load_model(policy)
    first = never_ending(first) if ignore_eos else first
    if jax.tree.map(jnp.shape, first.params) != jax.tree.map(jnp.shape, second.params):
        raise UserError(f"{policy} is not of the shape of {base}: their divergence has no meaning; compare a policy with what it began as")
    texts = read_prompts(prompts)
    width = max(map(len, prompts_tokens(texts, first.tokenizer)))
    named = {_named(each): load_rewards([each], first).score for each in scores}
    if len(named) < len(scores):
        raise UserError("a --reward is given twice: each is reported on its own, so give it once")
    return compare_with_base(
        first, second.params, make_prompts(texts, first.tokenizer, width), named, max_new_tokens=max_new_tokens, temperature=temperature,
        seed=seed,
    )  # fmt: skip


def best_completions(
    folder: Path, rewards: Sequence[Reward], prompts: Sequence[str], samples: int, *, max_new_tokens: int, temperature: float, seed: int,
    ignore_eos: bool = False, batch_size: int = 16,
) -> list[dict[str, object]]:  # fmt: skip
    """Of each prompt's samples the one of the highest reward, as rows that ``sft`` learns from: prompt, completion and its reward."""
    base = load_model(folder)
    base = never_ending(base) if ignore_eos else base
    score = load_rewards(rewards, base).score
    width = max(len(tokens) for tokens in base.tokenizer.encode_many(prompts))
    found = sample_many(
        base, make_prompts(prompts, base.tokenizer, width), score, samples, max_new_tokens=max_new_tokens, temperature=temperature,
        seed=seed, batch_size=batch_size,
    )  # fmt: skip
    return [
        {"prompt": prompt, "completion": found.written.completions[row * samples + place], "reward": float(found.proxy[row, place])}
        for row, (prompt, place) in enumerate(zip(prompts, best(found).tolist(), strict=True))
    ]


def as_json(found: Comparison) -> dict[str, object]:
    """A comparison as a file holds it."""
    return found._asdict() | {"judged": {name: each._asdict() for name, each in found.judged.items()}, "samples": list(found.samples)}


def configured(config_class: Callable[..., Config], settings: Mapping[str, object]) -> Config:
    """A Config with these settings, which it checks itself."""
    return config_class(**settings)


def _base_samples(base: LanguageModel, data: ComparisonData, seed: int) -> list[list[int]]:
    """Texts of the base on the prompts that were compared: what its rewards are scaled by."""
    texts = []
    for row in np.random.default_rng([seed, 11]).permutation(len(data.valid))[:128]:
        texts.append(base.tokenizer.decode(data.tokens[row, 0, : data.prompt_lengths[row]]))
    usable = [text for text in texts if base.tokenizer.encode(text)]
    prompts = make_prompts(usable, base.tokenizer, max(len(base.tokenizer.encode(text)) for text in usable))
    longest = int(data.segments.sum(axis=2).max() - data.prompt_lengths.min())
    samples = sample_many(base, prompts, lambda prompts, completions, ids: [0.0] * len(prompts), 2, max_new_tokens=longest, seed=seed)
    return samples.written.ids


def _value_params(reward: Rewards, base: LanguageModel) -> object | None:
    """The first reward model, its head scaled as its rewards are; nothing where it cannot say what a text is worth half-way.

    That is where it is of another shape than the policy, or its head has learnt to read the mean of all tokens: at single ones its numbers
    are so far off (explained variance -12 on the demo's first texts) that the policy drifts for nothing until they are unlearnt.
    """
    model = next((model for model in reward.models if model.pool == "last"), None)
    if model is None:
        return None
    if (model.config.hidden_size, model.config.num_layers) != (base.config.hidden_size, base.config.num_layers):
        return None
    return {**model.members[0], "score": {"kernel": model.members[0]["score"]["kernel"] / model.deviation}}


def _members(reward: Rewards) -> Callable[[Written], np.ndarray] | None:
    ensemble = next((model for model in reward.models if len(model.members) > 1), None)
    return None if ensemble is None else lambda written: ensemble.all_scores(written.ids)


def _function(name: str) -> Score:
    form = "a reward model's folder, module:function or path/to/file.py:function"
    found = attribute_in_file(name)
    if found is not None:
        module, attribute = load_file(found[0], "the reward"), found[1]
    else:
        place, colon, attribute = name.partition(":")
        if not colon:
            raise UserError(f"'{name}' is no reward: give {form}")
        module = import_module(place, name, form)
    function = getattr(module, attribute, None)
    if not callable(function):
        raise UserError(f"{name}: there is no function {attribute}; it must take prompts, completions and ids, and return a number a text")
    file = getattr(module, "__file__", None)
    return function_score(cast(Score, function), name, None if file is None else Path(file))
