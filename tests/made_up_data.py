"""Datasets made up for tests: small, in memory, with actions and rewards drawn by chance."""

from pathlib import Path

import numpy as np
from gymnasium import spaces

from thorndike.training.datasets import Dataset, Origin

BOX, DISCRETE = spaces.Box(-2.0, 2.0, (1,), np.float32), spaces.Discrete(2)


def made_up(action_space: spaces.Space = DISCRETE, lengths=(5, 7, 4), seed: int = 0, probability: float | None = 0.5) -> Dataset:
    """Episodes that end in turn by termination and by truncation; observations are 3 numbers."""
    dice, total = np.random.default_rng(seed), sum(lengths)
    obs = dice.normal(size=(total + 1, 3)).astype(np.float32)
    ends = np.cumsum(lengths) - 1
    terminated, truncated = np.zeros(total, bool), np.zeros(total, bool)
    terminated[ends[::2]], truncated[ends[1::2]] = True, True
    if isinstance(action_space, spaces.Box):
        action, probability = dice.uniform(action_space.low, action_space.high, (total, 1)).astype(np.float32), None
    else:
        action = dice.integers(action_space.n, size=total).astype(np.int32)
    observations = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    return Dataset(
        path=Path("made-up"),
        origin=Origin("MadeUp-v0", {}, None, observations, action_space),
        obs=obs[:-1],
        next_obs=obs[1:],
        action=action,
        reward=dice.normal(size=total).astype(np.float32),
        terminated=terminated,
        truncated=truncated,
        probability=None if probability is None else np.full(total, probability),
        lengths=np.array(lengths, np.int64),
        sha256="0" * 64,
    )
