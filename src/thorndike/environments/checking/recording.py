"""A game with random actions, kept for what is asked of it later: ends, rewards, ranges, and whether it can be repeated."""

from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.observations import Key, Leaf, check_leaves, key_of_values
from thorndike.environments.checking.play import Action, Outcome, Player, Sampler
from thorndike.environments.host.checks import bounds_hold

SMALL_OBSERVATION = 32
"""Observations of Box leaves with at most so many numbers in all are kept as numbers."""


class Row(NamedTuple):
    """A reset (``is_step`` False), or a step."""

    is_step: bool
    action: Action
    outcome: Outcome
    """Without its leaves, which the environment may write to."""


class Episode(NamedTuple):
    """How one episode ended."""

    length: int
    terminated: bool
    truncated: bool


class Range:
    """What one leaf has been: least, largest, mean square."""

    def __init__(self, leaf: Leaf) -> None:
        self.path, self.space = leaf.path, leaf.space
        self.low = self.high = np.asarray(leaf.array, np.float64)
        self._squares = np.zeros(leaf.array.shape)
        self.count = 0

    def add(self, array: np.ndarray) -> None:
        """One more observation."""
        values = np.asarray(array, np.float64)
        self.low, self.high = np.minimum(self.low, values), np.maximum(self.high, values)
        self._squares = self._squares + values * values
        self.count += 1

    @property
    def root_mean_square(self) -> np.ndarray:
        """How large the numbers are."""
        return np.sqrt(self._squares / max(self.count, 1))


class Recording:
    """What happened."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rows: list[Row] = []
        self.episodes: list[Episode] = []
        self.ranges: dict[str, Range] = {}
        self.vectors: list[np.ndarray] = []
        """The observation of each row as one vector; empty unless all leaves are Box and small."""

    @property
    def steps(self) -> int:
        """Steps kept."""
        return sum(row.is_step for row in self.rows)

    @property
    def rewards(self) -> np.ndarray:
        """The reward of each step."""
        return np.array([row.outcome.reward for row in self.rows if row.is_step])

    def add(self, is_step: bool, action: Action, outcome: Outcome) -> None:
        """One more row."""
        self.rows.append(Row(is_step, action, outcome._replace(leaves=[])))
        for leaf in outcome.leaves:
            self.ranges.setdefault(leaf.path, Range(leaf)).add(leaf.array)
        if all(isinstance(leaf.space, spaces.Box) for leaf in outcome.leaves):
            vector = np.concatenate([np.ravel(leaf.array).astype(np.float64) for leaf in outcome.leaves] or [np.zeros(0)])
            if 0 < vector.size <= SMALL_OBSERVATION:
                self.vectors.append(vector)


def record(player: Player, recording: Recording, sampler: Sampler, steps: int) -> None:
    """Play ``steps`` steps into ``recording``. Raises CannotGoOn, what came before being kept, if the environment cannot be played on."""
    outcome = _look(player, recording, player.reset(recording.seed), None, None)
    length = 0
    for _ in range(steps):
        action = sampler.draw(outcome.mask)
        outcome, before = player.step(action), outcome
        length += 1
        _look(player, recording, outcome, before, action)
        if outcome.ended:
            recording.episodes.append(Episode(length, outcome.terminated, outcome.truncated))
            outcome, before, length = player.reset(), outcome, 0
            _look(player, recording, outcome, before, None)


def play_on(player: Player, sampler: Sampler, episodes: list[Episode], wanted: int, most_steps: int) -> int:
    """Play whole episodes, from a reset, until there are ``wanted`` in all or ``most_steps`` are made; returns the steps made."""
    outcome, length = player.reset(), 0
    for made in range(most_steps):
        if len(episodes) >= wanted:
            return made
        outcome, length = player.step(sampler.draw(outcome.mask)), length + 1
        if outcome.ended:
            episodes.append(Episode(length, outcome.terminated, outcome.truncated))
            outcome, length = player.reset(), 0
    return most_steps


def _look(player: Player, recording: Recording, outcome: Outcome, before: Outcome | None, action: Action) -> Outcome:
    """Check an observation, and that the one before it is still what it was; keep it."""
    check_leaves(outcome.leaves, player.place, player.findings, loose_bounds=not bounds_hold(player.environment))
    if before is not None and (changed := _changed(before.key, before.leaves)):
        player.findings.warning(
            "observation_reused",
            f"{player.place}: {changed} returned before was written to, so whoever kept it holds the new one",
            "return a new array each time: observation.copy()",
        )
    recording.add(action is not None, action, outcome)
    return outcome


def _changed(key: Key, leaves: list[Leaf]) -> str | None:
    """The path of the first leaf that no longer is what it was."""
    now = key_of_values(leaves)
    return next((leaf.path for leaf, old, new in zip(leaves, key, now, strict=True) if old != new), None)
