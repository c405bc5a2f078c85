"""An environment of your own: a courier fetches a parcel in a yard and brings it to the door. Any Gymnasium class works like this one.

thorndike train ppo examples/own_environment.py:Courier --steps 60k --seeds 4
thorndike eval latest
thorndike watch latest --video courier.mp4
"""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

MOVES = ((0, 1), (0, -1), (1, 0), (-1, 0))
DOOR = (0, 0)
STEPS = 50
CELL = 32


class Courier(gymnasium.Env):
    """The yard has `size` x `size` cells. Each step costs 0.02; picking the parcel up is worth 0.5, bringing it to the door 1."""

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": 6}

    def __init__(self, size: int = 5, render_mode: str | None = None):
        self.size, self.render_mode = size, render_mode
        place = spaces.Box(0.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict({"courier": place, "parcel": place, "carrying": spaces.Discrete(2)})
        self.action_space = spaces.Discrete(len(MOVES))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """The courier anywhere, the parcel away from the walls of the door."""
        super().reset(seed=seed)
        self.courier = self.np_random.integers(self.size, size=2)
        self.parcel = self.np_random.integers(1, self.size, size=2)
        self.carrying, self.steps = False, 0
        return self.look(), {}

    def step(self, action: int):
        """One cell along; into a wall, nowhere."""
        self.courier = np.clip(self.courier + MOVES[action], 0, self.size - 1)
        self.steps += 1
        found = not self.carrying and bool((self.courier == self.parcel).all())
        self.carrying = self.carrying or found
        delivered = self.carrying and bool((self.courier == DOOR).all())
        reward = -0.02 + 0.5 * found + 1.0 * delivered
        # `terminated`: the task is over. `truncated`: only the clock ran out, and the future would have had a value.
        return self.look(), reward, delivered, self.steps >= STEPS, {}

    def look(self):
        """The observation; a parcel that is carried is where the courier is."""
        here, there = (np.asarray(place, np.float32) / (self.size - 1) for place in (self.courier, self.parcel))
        return {"courier": here, "parcel": here if self.carrying else there, "carrying": int(self.carrying)}

    def render(self):
        """The yard from above: the door green, the courier blue, the parcel orange."""
        picture = np.full((self.size * CELL, self.size * CELL, 3), 235, np.uint8)
        parcel = self.courier if self.carrying else self.parcel
        for (column, row), colour, margin in ((DOOR, (120, 180, 120), 0), (self.courier, (40, 90, 160), 4), (parcel, (210, 120, 30), 10)):
            top, left = row * CELL, column * CELL
            picture[top + margin : top + CELL - margin, left + margin : left + CELL - margin] = colour
        return picture
