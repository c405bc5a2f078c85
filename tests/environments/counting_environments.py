"""Environments whose every transition can be checked by looking at it. Loaded by path, so that worker processes find them too."""

import gymnasium
import numpy as np
from gymnasium import spaces

EPISODES_PER_SEED = 10_000


def length_of(episode: np.ndarray, longest: int) -> np.ndarray:
    return 1 + (episode * 7919) % longest


class CountingEnv(gymnasium.Env):
    """Observation: episode number (from the seed on), steps so far. Episodes end terminated, truncated or both, in turn."""

    def __init__(self, longest: int = 9, render_mode: str | None = None) -> None:
        self.longest = longest
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, np.inf, (2,), np.float64)
        self.action_space = spaces.Discrete(2)
        self.episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode = self.episode + 1 if seed is None else seed * EPISODES_PER_SEED
        self.count = 0
        return self.observe(), {}

    def step(self, action):
        self.count += 1
        ends = self.count == length_of(self.episode, self.longest)
        kind = self.episode % 3
        return self.observe(), float(self.count), ends and kind != 1, ends and kind != 0, {"cost": self.count + 0.5}

    def observe(self):
        return np.array([self.episode, self.count], np.float64)


class DictCountingEnv(CountingEnv):
    """The same as nested Dict and Tuple observations of several dtypes."""

    def __init__(self, longest: int = 9, render_mode: str | None = None) -> None:
        super().__init__(longest, render_mode)
        self.observation_space = spaces.Dict(
            {
                "state": spaces.Box(0, np.inf, (2,), np.float64),
                "picture": spaces.Box(0, 255, (2, 2, 1), np.uint8),
                "parts": spaces.Tuple([spaces.Discrete(100), spaces.Dict({"bits": spaces.MultiBinary(3)})]),
            }
        )

    def observe(self):
        picture = np.full((2, 2, 1), self.count, np.uint8)
        return {"state": super().observe(), "picture": picture, "parts": (self.count, {"bits": np.full(3, self.count % 2, np.int8)})}


class GreedyDiscreteEnv(gymnasium.Env):
    """Discrete actions that count from 5; the reward is the action."""

    observation_space = spaces.Discrete(3, start=1)
    action_space = spaces.Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        return 1, {}

    def step(self, action):
        assert self.action_space.contains(action)
        return 2, float(action), False, False, {}


class WideBoxEnv(gymnasium.Env):
    """Actions within [-2, 2]; anything beyond is an error, and the reward is the action."""

    observation_space = spaces.Box(-1, 1, (1,))
    action_space = spaces.Box(-2, 2, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return np.zeros(1, np.float32), action[0], False, False, {}


class WrongShapeEnv(WideBoxEnv):
    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}


class TextEnv(WideBoxEnv):
    observation_space = spaces.Text(5)
