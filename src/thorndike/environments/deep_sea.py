"""DeepSea-v0: a dive that pays only after N right moves in a row, in plain NumPy: what evaluation and films play, whatever trains.

Osband et al. 2019, "Behaviour Suite for Reinforcement Learning" (arXiv:1908.03568), its deterministic task; first in Osband, Van Roy,
Russo and Wen 2019, "Deep Exploration via Randomized Value Functions" (arXiv:1703.07608). A diver starts at the top left of an N x N grid
and sinks one row a step, one column to the left or to the right. Which of the two actions means right is drawn once for each cell. A move
to the right costs 0.01 / N; the last of N right moves is worth 1. So the best return is 0.99, staying left gives 0, and random actions
find the treasure in one of 2^N episodes. The actions of the cells are those that bsuite draws with the same ``mapping_seed``.
"""

from typing import Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.errors import UserError

Observed = Literal["one_hot", "index"]
PIXELS = 16
"""Of a cell's side in a picture."""

_METADATA: dict[str, object] = {"render_modes": ["rgb_array"], "render_fps": 4}


def right_actions(size: int, randomize_actions: bool, mapping_seed: int) -> np.ndarray:
    """Which action, 0 or 1, means right in each cell, ``[N, N]``: always 1 unless randomised."""
    if not randomize_actions:
        return np.ones((size, size), np.int32)
    return np.random.RandomState(mapping_seed).binomial(1, 0.5, (size, size)).astype(np.int32)


def observation_space(size: int, observation: str) -> gymnasium.Space:
    """The grid with a 1 where the diver is, or the number of the cell; after the end an empty grid, or ``N * N``.

    Raises UserError for another kind of observation, or a size below 2.
    """
    if not isinstance(size, int) or size < 2:
        raise UserError(f"size of DeepSea-v0 must be a whole number of at least 2, not {size!r}")
    if observation not in ("one_hot", "index"):
        raise UserError(f"observation of DeepSea-v0 must be 'one_hot' or 'index', not {observation!r}")
    return spaces.Box(0.0, 1.0, (size, size), np.float32) if observation == "one_hot" else spaces.Discrete(size * size + 1)


class DeepSeaEnv(gymnasium.Env):
    """The task as a Gymnasium environment. With ``observation="index"`` it carries its transition table, which planning reads."""

    metadata = _METADATA

    def __init__(
        self,
        size: int = 10,
        randomize_actions: bool = True,
        mapping_seed: int = 42,
        unscaled_move_cost: float = 0.01,
        observation: Observed = "one_hot",
        render_mode: str | None = None,
    ) -> None:
        """`size`: N. Raises UserError for a size below 2 or another kind of observation."""
        self.observation_space, self.action_space = observation_space(size, observation), spaces.Discrete(2)
        self.render_mode = render_mode
        self._size, self._indexed, self._cost = size, observation == "index", unscaled_move_cost / size
        self._right = right_actions(size, randomize_actions, mapping_seed)
        if self._indexed:
            self.P = {cell: {action: [self._outcome(cell, action)] for action in (0, 1)} for cell in range(size * size + 1)}
            self.initial_state_distrib = np.eye(1, size * size + 1)[0]

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[object, dict]:
        """To the top left."""
        super().reset(seed=seed)
        self._row = self._column = 0
        return self._observe(), {}

    def step(self, action: int) -> tuple[object, float, bool, bool, dict]:
        """One row down."""
        to_the_right = int(action) == self._right[self._row, self._column]
        reward = (float(self._column == self._size - 1) - self._cost) if to_the_right else 0.0
        self._column = min(max(self._column + (1 if to_the_right else -1), 0), self._size - 1)
        self._row += 1
        return self._observe(), reward, self._row == self._size, False, {}

    def render(self) -> np.ndarray:
        """The sea with the diver in it, and the treasure at the bottom right."""
        picture = np.full((self._size, self._size, 3), (24, 64, 128), np.uint8)
        picture[-1, -1] = (230, 190, 40)
        picture[min(self._row, self._size - 1), self._column] = (240, 240, 240)
        return picture.repeat(PIXELS, axis=0).repeat(PIXELS, axis=1)

    def _cell(self) -> int:
        return self._row * self._size + self._column if self._row < self._size else self._size**2

    def _observe(self) -> object:
        if self._indexed:
            return self._cell()
        return np.eye(1, self._size**2, self._cell(), np.float32).reshape(self._size, self._size)

    def _outcome(self, cell: int, action: int) -> tuple[float, int, float, bool]:
        """Probability, successor, reward and whether it ends, as Gymnasium's tables have them."""
        row, column = divmod(cell, self._size)
        if row == self._size:
            return 1.0, cell, 0.0, True
        self._row, self._column = row, column
        _, reward, ended, _, _ = self.step(action)
        return 1.0, self._cell(), reward, ended
