"""The demo's reward model: learnt from what real people said of film snippets, one of them a snippet and pass, all pairs of a batch."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

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

GROUP, WIDTH, HELD_OUT = 128, 48, 1500
"""Snippets compared with each other, their tokens at most, and how many are kept to measure with."""


def learn_from_ratings(
    base: LanguageModel, rated: Sequence[Rated], samples: Written, *, epochs: int, members: int, seed: int, log: Log | None = None
) -> RewardModel:
    """A reward model that knows how good it is on held-out snippets, scaled by the base's own texts."""
    generator = np.random.default_rng([seed, 71])
    order = generator.permutation(len(rated))
    tokens = base.tokenizer.encode_many([each.text for each in rated])
    usable = [number for number in order if 1 < len(tokens[number]) <= WIDTH]
    held_out, train = usable[:HELD_OUT], usable[HELD_OUT:]
    rows = []
    for _ in range(epochs):
        mixed = generator.permutation(train)
        rows += [mixed[start : start + GROUP] for start in range(0, len(mixed) - GROUP + 1, GROUP)]
    data = _all_pairs(rows, tokens, rated, base.tokenizer.pad_id, generator)
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
    rows: Sequence[np.ndarray], tokens: Sequence[Sequence[int]], rated: Sequence[Rated], pad_id: int, generator: np.random.Generator
) -> ComparisonData:
    first, second = np.triu_indices(GROUP, k=1)
    shape = (len(rows), GROUP, WIDTH)
    padded, segments = np.full(shape, pad_id, np.int32), np.zeros(shape, np.int32)
    said = np.zeros((len(rows), GROUP))
    for row, numbers in enumerate(rows):
        for place, number in enumerate(numbers):
            text = tokens[number]
            padded[row, place, : len(text)], segments[row, place, : len(text)] = text, 1
            said[row, place] = generator.choice(rated[number].ratings)
    gap = said[:, first] - said[:, second]
    p_first = np.where(gap == 0, 0.5, gap > 0).astype(np.float32)
    pairs = (len(rows), len(first))
    return ComparisonData(
        padded, segments, np.zeros(len(rows), np.int32), np.ones(shape[:2], bool), np.broadcast_to(first.astype(np.int32), pairs),
        np.broadcast_to(second.astype(np.int32), pairs), p_first, (gap != 0).astype(np.float32),
    )  # fmt: skip
