"""Best-of-n: of ``n`` completions the one that scores highest. No learning, and the yardstick of all that learns.

Stiennon et al. 2020 (arXiv:2009.01325), figure 5. Its divergence from the base is at most ``log n - (n - 1) / n`` (Beirami et al. 2024,
arXiv:2401.01879), which is what is reported as such; it is exact where no two completions are equal.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from thorndike.language.model import LanguageModel, stop_tokens
from thorndike.language.rewards import Score, checked_scores
from thorndike.language.rollouts import Prompts, Written, as_written, sample_rollout


class BestOf(NamedTuple):
    """What choosing among ``n`` gives, on average over prompts and over which of the samples there are to choose from."""

    n: int
    kl: float
    proxy: float
    """By the score that chose."""
    gold: float | None
    """By another, which did not."""


class Samples(NamedTuple):
    """Many completions of each prompt, and their scores."""

    written: Written
    proxy: Float[np.ndarray, "P N"]


def sample_many(
    model: LanguageModel, prompts: Prompts, score: Score, n: int, *, max_new_tokens: int, temperature: float = 1.0, seed: int = 0,
    batch_size: int = 16,
) -> Samples:  # fmt: skip
    """``n`` completions of each prompt."""
    rows, parts = len(prompts.texts), []
    size = min(batch_size, rows)
    for number, start in enumerate(range(0, rows, size)):
        chosen = np.minimum(np.arange(start, start + size), rows - 1)
        rollout = sample_rollout(
            model.params, model.config, prompts, chosen, jax.random.fold_in(jax.random.key(seed), number), max_new_tokens=max_new_tokens,
            temperature=temperature, stop_tokens=stop_tokens(model), pad_id=model.tokenizer.pad_id, samples=n,
        )  # fmt: skip
        parts.append(as_written(rollout, model.tokenizer))
    kept = rows * n
    written = Written(
        [text for part in parts for text in part.prompts][:kept],
        [text for part in parts for text in part.completions][:kept],
        [text for part in parts for text in part.ids][:kept],
        np.concatenate([part.lengths for part in parts])[:kept],
        np.concatenate([part.ended for part in parts])[:kept],
    )
    proxy = checked_scores(score, written.prompts, written.completions, written.ids)
    return Samples(written, proxy.reshape(rows, n))


def best(samples: Samples) -> Int[np.ndarray, " P"]:
    """The number of the best completion of each prompt."""
    return np.argmax(samples.proxy, axis=1)


def curve(samples: Samples, sizes: Sequence[int], gold: Float[np.ndarray, "P N"] | None = None) -> list[BestOf]:
    """What choosing among fewer would give, from the same samples: exact, over all choices of ``n`` among them (Stiennon et al. 2020)."""
    order = np.argsort(samples.proxy, axis=1, kind="stable")
    found = []
    for n in sizes:
        chance = chances(samples.proxy.shape[1], n)
        by = [float((np.take_along_axis(each, order, axis=1) @ chance).mean()) for each in (samples.proxy, gold) if each is not None]
        found.append(BestOf(n, math.log(n) - (n - 1) / n, by[0], by[1] if gold is not None else None))
    return found


def chances(total: int, n: int) -> Float[np.ndarray, " total"]:
    """The probability that each of ``total`` samples, worst first, is the best of ``n`` drawn from them without replacement."""

    # C(rank, n - 1) / C(total, n), by logarithms: the numbers themselves are beyond floats.
    def log_choose(a: int, b: int) -> float:
        return math.lgamma(a + 1) - math.lgamma(b + 1) - math.lgamma(a - b + 1)

    return np.array([math.exp(log_choose(rank, n - 1) - log_choose(total, n)) if rank >= n - 1 else 0.0 for rank in range(total)])
