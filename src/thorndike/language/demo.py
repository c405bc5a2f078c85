"""RLHF from end to end on one small model: reviews, a noisy crowd, a reward model of real people's ratings, PPO and its rivals, a report.

Each stage keeps what it made in the run's directory, so that the command, given again, goes on where it stopped.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.errors import UserError
from thorndike.language import dpo as direct
from thorndike.language import grpo as groups
from thorndike.language import ppo as proximal
from thorndike.language.best_of_n import curve, sample_many
from thorndike.language.comparisons import Comparison as PairOfTexts
from thorndike.language.comparisons import comparison_data
from thorndike.language.corpus import MOVIE_REVIEWS, read_corpus
from thorndike.language.decoder import Params
from thorndike.language.demo_labels import as_comparisons, judge_pairs
from thorndike.language.demo_reward import learn_from_ratings, rewards_of
from thorndike.language.learner import State
from thorndike.language.model import LanguageModel, load_model, never_ending, save_model
from thorndike.language.over_optimisation import Limits
from thorndike.language.policy_training import Task, train_policy
from thorndike.language.pretraining import base_model
from thorndike.language.reward_files import RewardModel, load_reward_model, refuse_if_near_chance, save_reward_model
from thorndike.language.rewards import Score, checked_scores
from thorndike.language.rollouts import Prompts
from thorndike.language.sentiment import Lexicon, Rated, have_reviews, read_lexicon, read_ratings
from thorndike.language.text_run import MODEL, open_run
from thorndike.language.tokenizer import Tokenizer
from thorndike.language.win_rate import Comparison, compare_with_base, written_by
from thorndike.settings import AtLeast, MoreThan, check, settings_of
from thorndike.training.run_directory import read_lines, write_json

PROMPT_LENGTH = 8


@dataclass(frozen=True)
class Config:
    """How large the demo is."""

    total_steps: Annotated[int, AtLeast(1)] = 40  # iterations of PPO, GRPO and RLOO
    free_steps: Annotated[int, AtLeast(1)] = 60  # iterations of PPO without a penalty
    episodes: Annotated[int, AtLeast(8)] = 128  # texts of an iteration
    max_new_tokens: Annotated[int, AtLeast(2)] = 24  # tokens of a completion
    ignore_eos: bool = True  # every text has so many, as in the paper: none is ended early
    learning_rate: Annotated[float, MoreThan(0)] = 3e-4  # of the policies, falling to 0
    kl_coefficient: Annotated[float, MoreThan(0)] = 0.3  # of the penalty, at first
    target_kl: Annotated[float, MoreThan(0)] = 6.0  # nats a text that the coefficient is steered to
    kl_horizon: Annotated[float, MoreThan(0)] = 800.0  # episodes over which it follows
    reward_epochs: Annotated[int, AtLeast(1)] = 1  # passes over the ratings
    reward_members: Annotated[int, AtLeast(1)] = 1  # reward models whose mean is the reward; of several, disagreement is watched
    pairs: Annotated[int, AtLeast(1)] = 4000  # of texts that the crowd judges
    dpo_learning_rate: Annotated[float, MoreThan(0)] = 3e-4  # of DPO, which takes one pass over the pairs, falling to 0
    max_kl: Annotated[float, MoreThan(0)] = 30.0  # nats a text beyond which a policy is stopped
    held_out: Annotated[int, AtLeast(1)] = 512  # prompts that policy and base are compared on

    def __post_init__(self) -> None:
        check(self)


class Data(NamedTuple):
    """What the demo is made of."""

    base: LanguageModel
    train: Prompts
    held_out: Prompts
    rated: Sequence[Rated]
    gold: Lexicon


Tell = Callable[[str], None]
Judged = Callable[[], tuple[list[PairOfTexts], dict[str, object]]]
"""What the crowd says of pairs of texts, made when it is first asked for, and how good that is."""


def review_prompts(texts: Sequence[str], tokenizer: Tokenizer, held_out: int) -> tuple[Prompts, Prompts]:
    """The first tokens of windows, from a word on, of reviews that the base has not read; those to compare on are of other reviews.

    Raises ``UserError`` where there are too few.
    """
    found: dict[tuple[int, ...], int] = {}
    begins = {token for token in range(tokenizer.vocab_size) if tokenizer.decode([token]).startswith(" ")}
    for review, tokens in enumerate(tokenizer.encode_many(texts)):
        last = -3 * PROMPT_LENGTH
        for start in range(len(tokens) - PROMPT_LENGTH + 1):
            if tokens[start] in begins and start >= last + 3 * PROMPT_LENGTH:
                found.setdefault(tuple(tokens[start : start + PROMPT_LENGTH]), review)
                last = start
    order = sorted(found, key=lambda window: found[window])
    if len(order) <= held_out:
        raise UserError(f"the held-out reviews give {len(order)} prompts; the demo needs more than {held_out}")
    parts = order[:-held_out], order[-held_out:]
    return (_as_prompts(parts[0], tokenizer), _as_prompts(parts[1], tokenizer))


def demo(out: Path, base: Path | None, config: Config, learners: Sequence[str], seed: int, tell: Tell) -> dict[str, object]:
    """Everything, from data that is fetched where it is missing, and a base that is made where none is given."""
    have_reviews()
    corpus = read_corpus(MOVIE_REVIEWS)
    if base is None:
        tell("the base model is made of film reviews, once")
        base = base_model()
    model = load_model(base)
    train, held_out = review_prompts(corpus.held_out, model.tokenizer, config.held_out)
    return run_demo(out, Data(model, train, held_out, read_ratings(), read_lexicon()), config, learners, seed, tell)


def run_demo(out: Path, data: Data, config: Config, learners: Sequence[str], seed: int, tell: Tell) -> dict[str, object]:
    """All stages; what was found, as ``report.json`` holds it."""
    data = data._replace(base=never_ending(data.base)) if config.ignore_eos else data
    # Not the learners: another may be added to what is there.
    open_run(out, {"verb": "demo", "seed": seed, "settings": settings_of(config)})
    began = time.perf_counter()
    found: dict[str, object] = {"seed": seed}
    kept = Kept(out, tell)
    judged = cache(lambda: _labels(data, config, seed))
    found["labels"] = kept.stage("labels", lambda: judged()[1])
    found["reward"] = kept.stage("reward", lambda: _reward(out / "reward", data, config, seed, tell))
    model = load_reward_model(out / "reward")
    refuse_if_near_chance(model)
    found["best_of_n"] = kept.stage("best_of_n", lambda: _best_of_n(data, model, config, seed))
    for learner in learners:
        found[learner] = kept.stage(learner, partial(_policy, out, data, model, judged, config, learner, seed, tell))
    found["wall_s"] = time.perf_counter() - began
    write_json(out / "report.json", found)
    return found


class Kept:
    """Stages that are done, as files of a run."""

    def __init__(self, out: Path, tell: Tell) -> None:
        """``tell`` is called with a line a stage."""
        self._folder, self._tell = out / "stages", tell
        self._folder.mkdir(parents=True, exist_ok=True)

    def stage(self, name: str, make: Callable[[], Mapping[str, object]]) -> dict[str, object]:
        """What a stage found, made now unless it was made before."""
        path = self._folder / f"{name}.json"
        if not path.exists():
            began, began_cpu = time.perf_counter(), time.process_time()
            write_json(path, {**make(), "wall_s": time.perf_counter() - began, "cpu_s": time.process_time() - began_cpu})
        content = json.loads(path.read_text(encoding="utf-8"))
        self._tell(f"{name}: {_in_short(content)}")
        return content


def _labels(data: Data, config: Config, seed: int) -> tuple[list[PairOfTexts], dict[str, object]]:
    """Pairs of the base's texts with what the crowd says of them, and how good that is."""
    prompts = _some(data.train, config.pairs)
    samples = sample_many(data.base, prompts, _nothing, 2, max_new_tokens=config.max_new_tokens, seed=seed, batch_size=64)
    utilities = data.gold.score([], samples.written.completions, []).reshape(-1, 2)
    labels = judge_pairs(utilities, seed)
    return as_comparisons(samples.written, labels), labels.quality._asdict()


def _reward(folder: Path, data: Data, config: Config, seed: int, tell: Tell) -> dict[str, object]:
    """Make the reward model, and say how good it is."""
    if not folder.exists():
        prompts = _some(data.train, 256)
        samples = sample_many(data.base, prompts, _nothing, 2, max_new_tokens=config.max_new_tokens, seed=seed + 1, batch_size=64)
        model = learn_from_ratings(
            data.base, data.rated, samples.written, width=config.max_new_tokens + 1, epochs=config.reward_epochs,
            members=config.reward_members, seed=seed,
            log=lambda step, metrics: tell(f"reward model, step {step}: loss {metrics['train/loss'][0]:.3f}") if step % 20 == 0 else None,
        )  # fmt: skip
        save_reward_model(model, folder)
    held_out = load_reward_model(folder).held_out
    return {} if held_out is None else held_out._asdict() | {"near_chance": held_out.near_chance}


def _best_of_n(data: Data, model: RewardModel, config: Config, seed: int) -> dict[str, object]:
    score, _ = rewards_of(model, data.base, PROMPT_LENGTH)
    prompts = _some(data.held_out, 64)
    samples = sample_many(data.base, prompts, score, 64, max_new_tokens=config.max_new_tokens, seed=seed + 2, batch_size=4)
    gold = data.gold.score([], samples.written.completions, []).reshape(-1, 64)
    return {"points": [each._asdict() for each in curve(samples, (1, 2, 4, 8, 16, 32, 64), gold)]}


def _policy(
    out: Path, data: Data, model: RewardModel, judged: Judged, config: Config, name: str, seed: int, tell: Tell
) -> dict[str, object]:
    """Train by one learner, and compare what came of it with the base."""
    score, _ = rewards_of(model, data.base, PROMPT_LENGTH)
    if name == "dpo":
        params, told = _by_dpo(data, judged()[0], score, config, seed)
    else:
        params, told = _by_rewards(out / name, data, model, config, name, seed, tell)
    found = compare_with_base(
        data.base, params, data.held_out, {"proxy": score, "gold": data.gold.score}, max_new_tokens=config.max_new_tokens, seed=seed + 3
    )
    folder = out / name / MODEL
    if not folder.exists():
        save_model(data.base._replace(params=params), folder)
    return told | _comparison(found)


def _by_rewards(
    run: Path, data: Data, model: RewardModel, config: Config, name: str, seed: int, tell: Tell
) -> tuple[Params, dict[str, object]]:
    score, members = rewards_of(model, data.base, PROMPT_LENGTH)
    base, limits = data.base, Limits(None, None, None, None) if name == "ppo_without_kl" else Limits(config.max_kl)
    if name.startswith("ppo"):
        of_ppo = _ppo_settings(config, free=name in ("ppo_without_kl", "ppo_max_kl"))
        settings: proximal.Config | groups.Config = of_ppo
        learner = proximal.ppo(of_ppo, base.config, base.params)
    else:
        of_groups = _group_settings(config, "group" if name == "grpo" else "leave_one_out")
        settings, learner = of_groups, groups.grpo(of_groups, base.config, base.params)
    open_run(run, {"verb": name, "seed": seed, "settings": settings_of(settings)})

    def follow(step: int, values: dict[str, float]) -> None:
        if step % 5 == 0:
            tell(f"{name}, step {step}: proxy {values['objective/score']:.2f}, gold {values['objective/gold']:.2f}, "
                 f"{values['objective/kl']:.1f} nats")  # fmt: skip

    task = Task(base, data.train, score, members if len(model.members) > 1 else None, {"gold": data.gold.score})
    outcome = train_policy(task, learner, settings, run, seed=seed, limits=limits, told=follow)
    if not outcome.finished:
        raise UserError(f"interrupted after {outcome.iterations} iterations of {name}; the same command goes on from there")
    return outcome.params, {
        "iterations": outcome.iterations,
        "stopped": outcome.stopped,
        "kl_in_training": outcome.kl,
        "curve": _curve(run),
    }


def _ppo_settings(config: Config, free: bool) -> proximal.Config:
    """``free``: without any penalty for leaving the base, and with a rate that does not fall."""
    return proximal.Config(
        total_steps=config.free_steps if free else config.total_steps,
        episodes=config.episodes,
        batch_size=config.episodes // 2,
        n_epochs=2,
        max_prompt_length=PROMPT_LENGTH,
        max_new_tokens=config.max_new_tokens,
        learning_rate=config.learning_rate if free else f"linear({config.learning_rate}, 0)",
        kl_coefficient=0.0 if free else config.kl_coefficient,
        target_kl=None if free else config.target_kl,
        kl_horizon=config.kl_horizon,
    )


def _group_settings(config: Config, baseline: str) -> groups.Config:
    return groups.Config(
        total_steps=config.total_steps,
        episodes=config.episodes,
        group=4,
        baseline=baseline,
        batch_size=config.episodes // 2,
        n_epochs=2,
        max_prompt_length=PROMPT_LENGTH,
        max_new_tokens=config.max_new_tokens,
        learning_rate=f"linear({config.learning_rate}, 0)",
        kl_coefficient=config.kl_coefficient,
        kl_in="reward",
        target_kl=config.target_kl,
        kl_horizon=config.kl_horizon,
    )


def _curve(run: Path) -> list[dict[str, float]]:
    """Proxy, gold and divergence of every iteration, from the log: an interrupted run has them from its first one."""
    rows = read_lines(run / "metrics.jsonl")
    names = ("score", "gold", "kl")
    return [{"step": float(str(row["steps"]))} | {name: cast(list[float], row[f"objective/{name}"])[0] for name in names} for row in rows]


def _by_dpo(data: Data, comparisons: Sequence[PairOfTexts], score: Score, config: Config, seed: int) -> tuple[Params, dict[str, object]]:
    pairs = comparison_data(comparisons, data.base.tokenizer.pad_id, PROMPT_LENGTH + config.max_new_tokens)
    reference = direct.reference_log_probs(data.base.params, data.base.config, pairs, 64)
    size = min(64, len(comparisons))
    steps = max(1, len(comparisons) // size)
    settings = direct.Config(total_steps=steps, batch_size=size, learning_rate=f"linear({config.dpo_learning_rate}, 0)", beta=0.05)
    learner = direct.dpo(settings, data.base.config)
    state: State = learner.init(data.base.params, jax.random.key(seed))
    update, order = jax.jit(learner.update, donate_argnums=0), np.random.default_rng(seed).permutation(len(comparisons))
    points = []
    for step in range(steps):
        rows = order[step * size : (step + 1) * size]
        state, _ = update(state, (), direct.Batch(pairs.rows(rows), jnp.asarray(reference[rows])))
        if (step + 1) * 4 // steps > step * 4 // steps:
            points.append(_point(data, learner.params(state, data.base.params), score, config, seed, step + 1))
    return learner.params(state, data.base.params), {"iterations": steps, "stopped": None, "curve": points}


def _point(data: Data, params: Params, score: Score, config: Config, seed: int, step: int) -> dict[str, float]:
    """Proxy, gold and divergence of texts that the policy writes now."""
    key = jax.random.fold_in(jax.random.key(seed), step)
    written, kl, _ = written_by(data.base, params, _some(data.train, 256), key, config.max_new_tokens, 1.0, 128)
    proxy, gold = (checked_scores(each, written.prompts, written.completions, written.ids) for each in (score, data.gold.score))
    return {"step": float(step), "score": float(proxy.mean()), "gold": float(gold.mean()), "kl": kl}


def _comparison(found: Comparison) -> dict[str, object]:
    return found._asdict() | {"judged": {name: each._asdict() for name, each in found.judged.items()}, "samples": list(found.samples)}


def _in_short(content: Mapping[str, object]) -> str:
    judged = content.get("judged")
    if isinstance(judged, dict):
        gold = judged["gold"]
        low, high = gold["win_rate_ci95"]
        return (
            f"wins {gold['win_rate']:.1%} [{low:.1%}, {high:.1%}] against the base at {content['kl']:.1f} nats; gold {gold['base']:.2f} -> "
            f"{gold['policy']:.2f}; repetition {content['repetition']:.2f}"
        )
    points = content.get("points")
    if isinstance(points, list):
        return ", ".join(f"best of {each['n']}: {each['gold']:.2f}" for each in points)
    return ", ".join(f"{name} {value:.3f}" for name, value in content.items() if isinstance(value, float))


def _nothing(prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> list[float]:
    """Nobody asks for the best."""
    return [0.0] * len(prompts)


def _some(prompts: Prompts, most: int) -> Prompts:
    return Prompts(prompts.tokens[:most], prompts.segments[:most], prompts.texts[:most])


def _as_prompts(windows: Sequence[tuple[int, ...]], tokenizer: Tokenizer) -> Prompts:
    tokens = np.array(windows, np.int32)
    return Prompts(tokens, np.ones_like(tokens), tuple(tokenizer.decode(window) for window in windows))
