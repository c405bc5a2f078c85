"""Simulated raters: they choose by a utility of the candidates, and err as people do, each in a way of their own."""

import math
import random
from collections.abc import Callable, Sequence
from typing import NamedTuple
from uuid import uuid4

import numpy as np

from thorndike.language.preferences.assignment import DEFAULT_PLAN, Plan, next_assignments
from thorndike.language.preferences.comparisons import Comparisons, Floats, Pair
from thorndike.language.preferences.judgements import Content, Response, Shown
from thorndike.language.preferences.store import Store

Utility = Callable[[Content, Content], float]
"""What a candidate is worth, from the prompt and the candidate."""


class Rater(NamedTuple):
    """How somebody chooses."""

    name: str
    temperature: float = 0.5
    """Of Bradley-Terry: the first wins with chance sigma((utility of the first - utility of the second) / temperature)."""
    lapse: float = 0.05
    """How often a key is hit without looking."""
    side_bias: float = 0.0
    """Added to the utility of what is shown first."""
    inverted: bool = False
    """Says the worst is best, perhaps because the keys were misunderstood."""
    ties: float = 0.0
    """Two utilities that differ by less are called a tie, where there are two candidates."""


def crowd(fair: int = 8, guessing: int = 3, inverted: int = 1) -> list[Rater]:
    """The crowd that label noise is measured with: fair ones, ones who guess, ones who have it the wrong way round."""
    return [
        *(Rater(f"fair-{each + 1}") for each in range(fair)),
        *(Rater(f"guessing-{each + 1}", lapse=1.0) for each in range(guessing)),
        *(Rater(f"inverted-{each + 1}", inverted=True) for each in range(inverted)),
    ]


def choose(rater: Rater, utilities: Sequence[float], draws: random.Random) -> tuple[str, list[int] | None]:
    """Verdict and ranks for candidates in the order shown; a ranking by Plackett-Luce where there are more than two."""
    biased = [utility * (-1 if rater.inverted else 1) + (rater.side_bias if place == 0 else 0.0) for place, utility in enumerate(utilities)]
    lapsed = draws.random() < rater.lapse
    if len(biased) == 2 and not lapsed and abs(biased[0] - biased[1]) < rater.ties:
        return "tie", None
    # The greatest of utility / temperature + Gumbel noise is a draw from softmax; sorting all of them, from Plackett-Luce.
    scores = [(0.0 if lapsed else utility / rater.temperature) - math.log(-math.log(_open(draws))) for utility in biased]
    order = sorted(range(len(scores)), key=lambda place: -scores[place])
    if len(biased) == 2:
        return "ab"[order[0]], None
    ranks = [0] * len(order)
    for rank, place in enumerate(order):
        ranks[place] = rank
    return "ranking", ranks


def crowd_comparisons(utilities: Floats, raters: Sequence[Rater], labels: int, seed: int = 0) -> Comparisons:
    """What a random few of the crowd say of pairs of known utilities ``[pairs, 2]``, ``labels`` of them each; without a store."""
    generator, draws = np.random.default_rng(seed), random.Random(f"crowd {seed}")
    rows = []
    for pair, (first, second) in enumerate(utilities.tolist()):
        for rater in generator.choice(len(raters), labels, replace=False).tolist():
            swapped = draws.random() < 0.5
            said, _ = choose(raters[rater], (second, first) if swapped else (first, second), draws)
            value = {"a": 1.0, "b": 0.0, "tie": 0.5}[said]
            rows.append((pair, rater, 1 - value if swapped else value))
    table = np.array(rows, np.float64).reshape(-1, 3)
    pairs = tuple(Pair(each, each, 2 * each, 2 * each + 1) for each in range(len(utilities)))
    numbers = table[:, :2].astype(np.int64)
    return Comparisons(pairs, tuple(each.name for each in raters), numbers[:, 0], numbers[:, 1], table[:, 2], np.ones(len(table)))


def let_them_judge(
    store: Store,
    project: int,
    raters: Sequence[Rater],
    utility: Utility,
    *,
    plan: Plan = DEFAULT_PLAN,
    most: int | None = None,
    seed: int = 0,
) -> int:
    """Let raters judge, in turns, until nothing is left or each has judged ``most``; how many judgements that made."""
    draws = random.Random(f"judging {seed}")
    numbers = {rater.name: store.rater(rater.name) for rater in raters}
    waiting, given = list(raters), dict.fromkeys(numbers, 0)
    run = uuid4().hex
    while waiting:
        for rater in list(waiting):
            assignments = next_assignments(store, project, numbers[rater.name], 1, plan)
            if not assignments or given[rater.name] == most:
                waiting.remove(rater)
                continue
            (shown,) = store.shown(assignments)
            verdict, ranks = choose(rater, _utilities(shown, utility), draws)
            store.judge(Response(shown.assignment, verdict, f"{run} {shown.assignment}", ranks, client="simulated"))
            given[rater.name] += 1
    return sum(given.values())


def _utilities(shown: Shown, utility: Utility) -> list[float]:
    return [utility(shown.prompt, candidate) for candidate in shown.candidates]


def _open(draws: random.Random) -> float:
    """From 0 to 1, both excluded."""
    return max(draws.random(), 2.0**-53)
