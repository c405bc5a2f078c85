"""Environments and learners small enough to be trained in a test."""

import os
import signal

import gymnasium
import numpy as np
from gymnasium import spaces

PPO_SETTINGS = {"n_steps": 8, "batch_size": 16, "n_epochs": 2, "net_arch": (8,)}


class Corridor(gymnasium.Env):
    """Five cells; action 1 goes right, which ends it at the last one with reward 1; cut after 12 steps. Starts at a random cell."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = spaces.Box(0, 1, (3,))
    action_space = spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell, self.age = int(self.np_random.integers(3)), 0
        return self.observe(), {}

    def step(self, action):
        self.age += 1
        self.cell = max(0, self.cell + (1 if action == 1 else -1))
        ends = self.cell == 4
        return self.observe(), 1.0 if ends else -0.01, ends, self.age >= 12, {}

    def observe(self):
        return np.array([self.cell / 4, self.age / 12, 1], np.float32)

    def render(self):
        return np.full((20, 30, 3), 50 * self.cell, np.uint8)


class DictCorridor(Corridor):
    """The same seen as a Dict of a number and a picture."""

    observation_space = spaces.Dict({"place": spaces.Discrete(5), "shown": spaces.Tuple([spaces.Box(0, 255, (2, 2), np.uint8)])})

    def observe(self):
        return {"place": self.cell, "shown": (np.full((2, 2), 20 * self.age, np.uint8),)}


class CountedFromThree(Corridor):
    """The same with the actions 3 and 4."""

    observation_space = spaces.Discrete(5)
    action_space = spaces.Discrete(2, start=3)

    def step(self, action):
        assert self.action_space.contains(action), action
        return super().step(int(action) - 3)

    def observe(self):
        return self.cell


class InterruptedCorridor(Corridor):
    """The same, whose user presses Ctrl-C in step ``presses_at`` of all environments together, once."""

    steps_made = 0
    presses_at = 0

    def step(self, action):
        InterruptedCorridor.steps_made += 1
        if InterruptedCorridor.steps_made == InterruptedCorridor.presses_at:
            os.kill(os.getpid(), signal.SIGINT)
        return super().step(action)


class Lengths(gymnasium.Env):
    """Whatever is done, episode ``k`` takes ``1 + 7 k mod 5`` steps; episodes end in a death and at a limit in turn."""

    observation_space = spaces.Box(0, 10, (2,))
    action_space = spaces.Discrete(2)

    def __init__(self) -> None:
        self.episode = -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.age = (self.episode + 1 if seed is None else 0), 0
        return self.observe(), {}

    def step(self, action):
        self.age += 1
        ends = self.age == 1 + 7 * self.episode % 5
        dies = self.episode % 2 == 0
        return self.observe(), float(self.age), ends and dies, ends and not dies, {}

    def observe(self):
        return np.array([self.age, self.episode % 10], np.float32)
