"""A policy beside its base on prompts that it did not learn from: how often it wins, how far it has gone, how its texts have changed."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from thorndike.language.decoder import Params
from thorndike.language.model import LanguageModel, stop_tokens
from thorndike.language.over_optimisation import repetition
from thorndike.language.rewards import Score, checked_scores
from thorndike.language.rollouts import Prompts, Rollout, Written, as_written, distance, distance_metrics, sample_rollout
from thorndike.statistics.estimates import wilson_interval


class Judged(NamedTuple):
    """Policy and base by one score."""

    policy: float
    base: float
    win_rate: float
    """Prompts on which the policy's text scores higher; equal scores count half."""
    win_rate_ci95: tuple[float, float]


class Comparison(NamedTuple):
    """What was found."""

    prompts: int
    kl: float
    """Exact, nats a text."""
    kl_k1: float
    length: float
    base_length: float
    repetition: float
    base_repetition: float
    judged: Mapping[str, Judged]
    """By the score's name."""
    samples: Sequence[Mapping[str, object]]
    """Some prompts with both texts."""


def compare_with_base(
    base: LanguageModel, params: Params, prompts: Prompts, scores: Mapping[str, Score], *, max_new_tokens: int, temperature: float = 1.0,
    seed: int = 0, samples: int = 20, batch_size: int = 128,
) -> Comparison:  # fmt: skip
    """Let both answer every prompt once, and compare."""
    key_policy, key_base = jax.random.split(jax.random.key(seed))
    ours, kl, k1 = written_by(base, params, prompts, key_policy, max_new_tokens, temperature, batch_size)
    theirs, _, _ = written_by(base, base.params, prompts, key_base, max_new_tokens, temperature, batch_size)
    judged, by_score = {}, {}
    for name, score in scores.items():
        mine, other = (checked_scores(score, each.prompts, each.completions, each.ids) for each in (ours, theirs))
        judged[name] = judge(mine, other)
        by_score[name] = (mine, other)
    rows = [
        {
            "prompt": ours.prompts[row], "base": theirs.completions[row], "policy": ours.completions[row],
            **{name: {"base": float(other[row]), "policy": float(mine[row])} for name, (mine, other) in by_score.items()},
        }
        for row in range(min(samples, len(prompts.texts)))
    ]  # fmt: skip
    return Comparison(
        len(prompts.texts), kl, k1, float(ours.lengths.mean()), float(theirs.lengths.mean()), _repetition(ours), _repetition(theirs),
        judged, rows,
    )  # fmt: skip


def judge(policy: Float[np.ndarray, " N"], base: Float[np.ndarray, " N"]) -> Judged:
    """The win rate of scores on the same prompts."""
    wins = float(np.where(policy == base, 0.5, policy > base).sum())
    return Judged(float(policy.mean()), float(base.mean()), wins / len(policy), wilson_interval(wins, len(policy)))


def written_by(
    base: LanguageModel, params: Params, prompts: Prompts, key: Key[Array, ""], max_new_tokens: int, temperature: float, batch_size: int
) -> tuple[Written, float, float]:
    """One text a prompt, their exact divergence from the base in nats a text, and the same by k1."""
    rows, parts, exact, sampled = len(prompts.texts), [], [], []
    size = min(batch_size, rows)
    for number, start in enumerate(range(0, rows, size)):
        chosen = np.minimum(np.arange(start, start + size), rows - 1)
        rollout: Rollout = sample_rollout(
            params, base.config, prompts, chosen, jax.random.fold_in(key, number), max_new_tokens=max_new_tokens, temperature=temperature,
            stop_tokens=stop_tokens(base), pad_id=base.tokenizer.pad_id,
        )  # fmt: skip
        metrics = distance_metrics(rollout, distance(params, base.params, base.config, rollout, temperature))
        exact.append(float(metrics["objective/kl"]))
        sampled.append(float(metrics["objective/kl_k1"]))
        parts.append(as_written(rollout, base.tokenizer))
    joined = Written(
        [text for part in parts for text in part.prompts][:rows],
        [text for part in parts for text in part.completions][:rows],
        [text for part in parts for text in part.ids][:rows],
        np.concatenate([part.lengths for part in parts])[:rows],
        np.concatenate([part.ended for part in parts])[:rows],
    )
    return joined, float(np.mean(exact)), float(np.mean(sampled))


def _repetition(written: Written) -> float:
    rows = zip(written.ids, written.lengths, strict=True)
    return float(np.mean([repetition(ids[len(ids) - length :]) for ids, length in rows]))
