"""The demo's crowd: pairs of the base's own texts, judged by simulated raters of whom some guess and one has it the wrong way round."""

import random
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from thorndike.language.comparisons import Comparison, preferred
from thorndike.language.preferences.comparisons import Comparisons, Pair
from thorndike.language.preferences.noise import Belief, dawid_skene, majority
from thorndike.language.preferences.raters import Rater, choose, crowd
from thorndike.language.rollouts import Written


class LabelQuality(NamedTuple):
    """How often labels say what the raters' own yardstick says."""

    single: float
    """One rater a pair."""
    majority: float
    dawid_skene: float
    reliability: dict[str, float]
    """Of each rater, as found."""


class Labels(NamedTuple):
    """Pairs of texts, and what is believed of them."""

    first_is_better: Float[np.ndarray, " pairs"]
    quality: LabelQuality


def judge_pairs(utilities: Float[np.ndarray, "pairs 2"], seed: int, labels_a_pair: int = 3) -> Labels:
    """Have the crowd judge every pair ``labels_a_pair`` times, and put its verdicts together."""
    raters = crowd()
    said = _verdicts(utilities, raters, random.Random(f"crowd {seed}"), labels_a_pair)
    truth = utilities[:, 0] > utilities[:, 1]
    differs = utilities[:, 0] != utilities[:, 1]
    found = dawid_skene(said).belief
    quality = LabelQuality(
        single=float(((said.value[::labels_a_pair] > 0.5) == truth)[differs].mean()),
        majority=_accuracy(majority(said), truth, differs),
        dawid_skene=_accuracy(found, truth, differs),
        reliability={name: float(each) for name, each in zip(said.raters, found.reliability, strict=True)},
    )
    return Labels(found.first_is_better, quality)


def as_comparisons(written: Written, labels: Labels) -> list[Comparison]:
    """The texts of a rollout with two samples a prompt, as pairs with soft labels; where a text is empty the pair is left out."""
    kept = []
    for pair, chance in enumerate(labels.first_is_better):
        a, b = written.ids[2 * pair], written.ids[2 * pair + 1]
        lengths = written.lengths[2 * pair : 2 * pair + 2]
        if min(lengths) > 0:
            prompt = a[: len(a) - int(lengths[0])]
            kept.append(preferred(prompt, a[len(prompt) :], b[len(prompt) :], float(chance)))
    return kept


def _verdicts(utilities: Float[np.ndarray, "pairs 2"], raters: Sequence[Rater], draws: random.Random, labels: int) -> Comparisons:
    pairs, rater, value = [], [], []
    for number, both in enumerate(utilities.tolist()):
        for who in draws.sample(range(len(raters)), labels):
            # The sides are shown in random order, as people are shown them.
            turned = draws.random() < 0.5
            verdict, _ = choose(raters[who], both[::-1] if turned else both, draws)
            pairs.append(number)
            rater.append(who)
            value.append(0.5 if verdict == "tie" else float((verdict == "a") != turned))
    index = tuple(Pair(number, number, 2 * number, 2 * number + 1) for number in range(len(utilities)))
    names = tuple(each.name for each in raters)
    return Comparisons(index, names, np.array(pairs), np.array(rater), np.array(value), np.ones(len(pairs)))


def _accuracy(belief: Belief, truth: np.ndarray, differs: np.ndarray) -> float:
    """A belief of one half is right half the time."""
    right = np.where(belief.first_is_better == 0.5, 0.5, (belief.first_is_better > 0.5) == truth)
    return float(right[differs].mean())
