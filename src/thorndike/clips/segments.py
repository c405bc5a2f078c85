"""Clips as arrays: what a reward is learnt from, and what a simulated rater goes by."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped


class Segments(NamedTuple):
    """``N`` clips of up to ``L`` steps. A clip in which the episode terminated is shorter; its rest is filled with zeros."""

    obs: tuple[Shaped[np.ndarray, "N L ..."], ...]
    """What was acted on, as the environment shows it: its leaves, without an action mask."""
    action: Shaped[np.ndarray, "N L ..."]
    """In the environment's units, whole numbers from 0."""
    reward: Float[np.ndarray, "N L"]
    """The environment's own: nothing is learnt from it, it is for simulated raters."""
    valid: Bool[np.ndarray, "N L"]

    @property
    def number(self) -> int:
        """N."""
        return len(self.valid)

    @property
    def returns(self) -> Float[np.ndarray, " N"]:
        """The sum of each clip's own rewards."""
        return (self.reward * self.valid).sum(axis=1)

    @property
    def all_whole(self) -> bool:
        """Whether no clip is shorter than the others."""
        return bool(self.valid.all())

    def take(self, places: Sequence[int] | np.ndarray) -> "Segments":
        """Some of the clips, in this order."""
        return jax.tree.map(lambda x: x[np.asarray(places, np.int64)], self)


class Choices(NamedTuple):
    """Pairs of clips that were judged, as places in all clips of the folder."""

    first: Int[np.ndarray, " N"]
    second: Int[np.ndarray, " N"]
    p_first: Float[np.ndarray, " N"]
    """How likely the first is the better one: 0.5 for a tie."""

    @property
    def number(self) -> int:
        """N."""
        return len(self.first)


class Row(NamedTuple):
    """One step of one environment."""

    obs: tuple[np.ndarray, ...]
    action: np.ndarray
    reward: float


def segment(rows: Sequence[Row], length: int) -> Segments:
    """One clip ``[1, L]`` of at least one and at most ``length`` steps."""

    def filled(values: Sequence[np.ndarray]) -> np.ndarray:
        stacked = np.stack([np.asarray(value) for value in values])
        rest = np.zeros((length - len(stacked), *stacked.shape[1:]), stacked.dtype)
        return np.concatenate([stacked, rest])[None]

    leaves = zip(*(row.obs for row in rows), strict=True)
    reward = filled([np.array(row.reward, np.float32) for row in rows])
    return Segments(tuple(map(filled, leaves)), filled([row.action for row in rows]), reward, np.arange(length)[None] < len(rows))


def together(parts: Sequence[Segments]) -> Segments:
    """All clips of several, which must be of one environment and one length."""
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
