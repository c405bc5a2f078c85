"""Pictures large enough to look at, from environments that draw one pixel a cell."""

import gymnasium
import numpy as np

PIXELS = 32
"""Width and height of a cell."""


class Magnified(gymnasium.Wrapper):
    """MinAtar's games draw ``float[10, 10, 3]`` in [0, 1]; here ``uint8[320, 320, 3]``, slow enough to follow."""

    def __init__(self, environment: gymnasium.Env):
        super().__init__(environment)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 12}

    def render(self) -> np.ndarray:
        """The picture ``uint8[height, width, 3]``."""
        picture = np.asarray(self.env.render())
        return np.round(255 * picture).astype(np.uint8).repeat(PIXELS, axis=0).repeat(PIXELS, axis=1)
