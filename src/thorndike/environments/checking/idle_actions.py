"""Actions that never make a difference: from the same points of a game, played again from its seed, each is tried.

Compared are the step and those after it, so that what shows late counts. What is left after all points is named; an action that differs
in rare states only may be named wrongly, so it is a hint.
"""

from collections import Counter
from itertools import combinations
from typing import NamedTuple, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import Findings
from thorndike.environments.checking.masks import Mask
from thorndike.environments.checking.observations import Key
from thorndike.environments.checking.play import Action, Player, Sampler

LONGEST_PREFIX = 40
STEPS_AFTER = 8
MOST_CHOICES = 18
FEWEST_POINTS = 20
MOST_POINTS_ASIDE = 60
"""After so many points, pairs of actions that no point allowed both of are left aside."""

Played: TypeAlias = list[tuple[Key, str, bool]]
Pair: TypeAlias = tuple[int, int]


class Point(NamedTuple):
    """A point of a game: what leads there, and what may be done there."""

    seed: int
    actions: list[Action]
    mask: Mask | None


def check_idle_actions(player: Player, seed: int, most_cost: int, findings: Findings) -> None:
    """Names actions, or dimensions of actions, that changed nothing. Raises CannotGoOn as playing does."""
    space = player.environment.action_space
    most_cost += player.cost
    match space:
        case spaces.Discrete() if space.n > 1:
            _check_choices(player, space, seed, most_cost, findings)
        case spaces.MultiDiscrete() | spaces.MultiBinary() | spaces.Box():
            _check_dimensions(player, seed, most_cost, findings)


def _check_choices(player: Player, space: spaces.Discrete, seed: int, most_cost: int, findings: Findings) -> None:
    first = int(space.start)
    alike = set(combinations(range(first, first + min(int(space.n), MOST_CHOICES)), 2))
    compared: Counter[Pair] = Counter()
    points = 0
    while alike and player.cost < most_cost:
        alike -= _told_apart(player, _point(player, seed + points), alike, first, compared)
        points += 1
        if points >= MOST_POINTS_ASIDE:
            # Actions that a mask never allows in one state cannot be compared.
            alike = {pair for pair in alike if compared[pair]}
    for group in _groups({pair for pair in alike if compared[pair] >= FEWEST_POINTS}):
        findings.hint(
            "idle_actions",
            f"{'all actions' if len(group) == space.n else 'actions ' + ', '.join(map(str, group))} did the same at "
            f"{compared[group[0], group[1]]} points of the game and in the {STEPS_AFTER} steps after",
            "check that step uses the action; if these are the same on purpose, leave all but one out",
            str(group),
        )


def _told_apart(player: Player, point: Point, alike: set[Pair], first: int, compared: Counter[Pair]) -> set[Pair]:
    """The pairs that do not do the same here."""
    allowed = {action for pair in alike for action in pair if point.mask is None or np.asarray(point.mask)[action - first]}
    here = [pair for pair in alike if allowed.issuperset(pair)]
    played = {action: _after(player, point, np.int64(action)) for action in sorted({action for pair in here for action in pair})}
    compared.update(here)
    return {(one, other) for one, other in here if played[one] != played[other]}


def _groups(pairs: set[Pair]) -> list[list[int]]:
    """Actions that are the same as one another, together."""
    groups: list[list[int]] = []
    for one, other in sorted(pairs):
        group = next((members for members in groups if one in members), None)
        if group is None:
            groups.append([one, other])
        elif other not in group:
            group.append(other)
    return groups


def _check_dimensions(player: Player, seed: int, most_cost: int, findings: Findings) -> None:
    space = player.environment.action_space
    numbers = [number for number in range(int(np.prod(space.shape or ()))) if _extremes(space, None, number) is not None]
    idle = set(numbers)
    compared: Counter[int] = Counter()
    points = 0
    while idle and player.cost < most_cost:
        point = _point(player, seed + points)
        idle -= {number for number in idle if _matters(player, point, number, compared)}
        points += 1
        if points >= MOST_POINTS_ASIDE:
            idle = {number for number in idle if compared[number]}
    idle = {number for number in idle if compared[number] >= FEWEST_POINTS}
    if idle:
        which = "no dimension of the action" if len(idle) == len(numbers) else f"no choice in dimensions {sorted(idle)} of the action"
        findings.hint(
            "idle_actions",
            f"{which} changed anything at {min(compared[number] for number in idle)} points of the game and in {STEPS_AFTER} steps after",
            "check that step uses them; if they are idle on purpose, leave them out of action_space",
        )


def _matters(player: Player, point: Point, number: int, compared: Counter[int]) -> bool:
    """Whether the least and the largest value of one dimension do anything different here."""
    space = player.environment.action_space
    extremes = _extremes(space, point.mask, number)
    if extremes is None:
        return False
    compared[number] += 1
    low, high = (np.array(Sampler(space, point.seed).draw(point.mask)) for _ in extremes)
    low.flat[number], high.flat[number] = extremes
    return _after(player, point, low) != _after(player, point, high)


def _extremes(space: gymnasium.Space, mask: Mask | None, number: int) -> tuple[float, float] | None:
    """The least and the largest value that one dimension may have (-1 and 1 where it is endless); None if there is no choice."""
    match space:
        case spaces.Box():
            low, high = float(space.low.flat[number]), float(space.high.flat[number])
            return (low if np.isfinite(low) else -1.0, high if np.isfinite(high) else 1.0) if low < high else None
        case spaces.MultiDiscrete():
            start, count = int(space.start.flat[number]), int(space.nvec.flat[number])
            allowed = np.flatnonzero(mask[number] if isinstance(mask, tuple) else np.ones(count)) + start
            return (int(allowed[0]), int(allowed[-1])) if len(allowed) > 1 else None
    return (0, 1) if mask is None or np.asarray(mask).flat[number] == 2 else None


def _point(player: Player, seed: int) -> Point:
    """A point some random steps after a reset, before an end."""
    sampler = Sampler(player.environment.action_space, seed)
    outcome = player.reset(seed)
    actions: list[Action] = []
    mask = outcome.mask
    for _ in range(seed * 7 % LONGEST_PREFIX):
        action = sampler.draw(mask)
        outcome = player.step(action)
        if outcome.ended:
            break
        actions.append(action)
        mask = outcome.mask
    return Point(seed, actions, mask)


def _after(player: Player, point: Point, action: Action) -> Played:
    """What an action does at a point, and what follows with the same actions after it."""
    player.reset(point.seed)
    for before in point.actions:
        player.step(before)
    sampler = Sampler(player.environment.action_space, point.seed)
    outcome = player.step(action)
    played = [(outcome.key, str(outcome.reward), outcome.ended)]
    while len(played) <= STEPS_AFTER and not outcome.ended:
        outcome = player.step(sampler.draw(outcome.mask))
        played.append((outcome.key, str(outcome.reward), outcome.ended))
    return played
