"""The demo's reward model: learnt from what real people said of snippets, all pairs of a batch.

Learnt are windows as long as the completions that it is to score, which begin anywhere, as they do; what a pair is labelled with is the
share of its raters, one of each snippet, who say more of the first.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from thorndike.language.comparisons import ComparisonData
from thorndike.language.model import LanguageModel
from thorndike.language.policy_training import Members
from thorndike.language.reward_files import RewardModel, normalised
from thorndike.language.reward_model import Config, reward_model
from thorndike.language.reward_report import held_out_report
from thorndike.language.reward_training import Log, fit
from thorndike.language.rewards import Score
from thorndike.language.rollouts import Written
from thorndike.language.sentiment import Rated

GROUP, HELD_OUT, LONGEST = 128, 1500, 48
"""Snippets compared with each other, and how many of films, with so many tokens at most, are kept to measure with."""
_HIGHEST = 4
"""Ratings are from -4 to 4."""


def learn_from_ratings(
    base: LanguageModel, rated: Sequence[Rated], samples: Written, *, width: int, epochs: int, members: int, seed: int,
    log: Log | None = None,
) -> RewardModel:  # fmt: skip
    """A reward model of texts of ``width`` tokens that knows how good it is on held-out snippets, scaled by the base's own texts."""
    generator = np.random.default_rng([seed, 71])
    tokens = base.tokenizer.encode_many([each.text for each in rated])
    usable = [number for number in generator.permutation(len(rated)) if len(tokens[number]) > 1]
    films = [number for number in usable if rated[number].source == "film" and len(tokens[number]) <= LONGEST]
    held_out = films[:HELD_OUT]
    train = sorted({*usable} - {*held_out})
    rows = []
    for _ in range(epochs):
        mixed = generator.permutation(train)
        rows += [mixed[start : start + GROUP] for start in range(0, len(mixed) - GROUP + 1, GROUP)]
    data = _all_pairs(rows, tokens, rated, width, base, generator)
    config = Config(total_steps=len(rows), batch_size=1, pool="mean")
    params = fit(reward_model(config, base.config), config, base.params, data, members=members, seed=seed, log=log)
    model = RewardModel(replace(base.config, num_labels=1), tuple(params), base.tokenizer, "mean")
    scores = model.score([], [], [tokens[number] for number in held_out])
    human = np.array([np.mean(rated[number].ratings) for number in held_out])
    # Each snippet is in one pair, so that pairs are independent of each other.
    first, second = np.arange(0, HELD_OUT, 2), np.arange(1, HELD_OUT, 2)
    gap = human[first] - human[second]
    label = np.where(gap == 0, 0.5, gap > 0).astype(np.float32)
    model = model._replace(held_out=held_out_report(scores[first], scores[second], label, gap))
    return normalised(model, completions_alone(samples.ids, samples.lengths, base))


def window(text: Sequence[int], width: int, base: LanguageModel, generator: np.random.Generator) -> list[int]:
    """So many tokens of a text, from anywhere, as a text of its own."""
    if len(text) <= width:
        return list(text)
    begin = [] if base.tokenizer.bos_id is None else [base.tokenizer.bos_id]
    inside, size = text[len(begin) :], width - len(begin)
    start = int(generator.integers(0, len(inside) - size + 1))
    return [*begin, *inside[start : start + size]]


def opinions(
    ratings: Sequence[Sequence[int]], first: Int[np.ndarray, " pairs"], second: Int[np.ndarray, " pairs"]
) -> tuple[Float[np.ndarray, " pairs"], Float[np.ndarray, " pairs"]]:
    """Of all pairings of a rater of the first and one of the second: the share that prefers the first among those who differ, and theirs.

    The expectation of asking one rater of each, as a label and its weight.
    """
    said = np.stack([np.bincount(np.clip(each, -_HIGHEST, _HIGHEST) + _HIGHEST, minlength=2 * _HIGHEST + 1) for each in ratings])
    share = said / said.sum(axis=1, keepdims=True)
    higher = share @ (np.cumsum(share, axis=1) - share).T
    ahead, behind = higher[first, second], higher[second, first]
    differ = ahead + behind
    return np.where(differ > 0, ahead / np.maximum(differ, 1e-9), 0.5), differ


def completions_alone(ids: Sequence[Sequence[int]], lengths: Sequence[int] | np.ndarray, base: LanguageModel) -> list[list[int]]:
    """The completions without their prompts, as texts of their own: what the ratings were of."""
    begin = [] if base.tokenizer.bos_id is None else [base.tokenizer.bos_id]
    return [[*begin, *row[len(row) - int(length) :]] for row, length in zip(ids, lengths, strict=True)]


def rewards_of(model: RewardModel, base: LanguageModel, prompt_length: int, clip: float = 5.0) -> tuple[Score, Members]:
    """The model as a reward of completions, and its members' opinions."""

    def members(written: Written) -> Float[np.ndarray, "E B"]:
        return model.all_scores(completions_alone(written.ids, written.lengths, base))

    def score(prompts: Sequence[str], completions: Sequence[str], ids: Sequence[Sequence[int]]) -> Float[np.ndarray, " B"]:
        lengths = [len(row) - prompt_length for row in ids]
        return np.clip(model.all_scores(completions_alone(ids, lengths, base)).mean(axis=0), -clip, clip)

    return score, members


def _all_pairs(
    rows: Sequence[np.ndarray], tokens: Sequence[Sequence[int]], rated: Sequence[Rated], width: int, base: LanguageModel,
    generator: np.random.Generator,
) -> ComparisonData:  # fmt: skip
    first, second = (each.astype(np.int32) for each in np.triu_indices(GROUP, k=1))
    shape, pairs = (len(rows), GROUP, width), (len(rows), len(first))
    padded, segments = np.full(shape, base.tokenizer.pad_id, np.int32), np.zeros(shape, np.int32)
    p_first, weight = np.zeros(pairs, np.float32), np.zeros(pairs, np.float32)
    for row, numbers in enumerate(rows):
        for place, number in enumerate(numbers):
            text = window(tokens[number], width, base, generator)
            padded[row, place, : len(text)], segments[row, place, : len(text)] = text, 1
        p_first[row], weight[row] = opinions([rated[number].ratings for number in numbers], first, second)
    return ComparisonData(
        padded, segments, np.zeros(len(rows), np.int32), np.ones(shape[:2], bool), np.broadcast_to(first, pairs),
        np.broadcast_to(second, pairs), p_first, weight,
    )  # fmt: skip
