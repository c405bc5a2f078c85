"""One Atari game with the usual preprocessing around Gymnasium's own environment: what policies are evaluated and filmed on.

It is frame for frame what ``AtariVectorEnv`` shows (tests/environments/test_atari.py steps both side by side), written from what that
does: the same repeats, the maximum of the last two frames, an average over areas that rounds like OpenCV's ``INTER_AREA``. Without OpenCV,
which would be a large package for two small matrix products. Kept free of JAX, so that worker processes start fast.
"""

from collections import deque

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from thorndike.environments.host.atari import AtariSettings, episode_limit

NOOP, FIRE = 0, 1
"""ALE's numbers of these actions, whatever the set of actions."""


def atari_game(id: str, settings: AtariSettings, max_episode_steps: int | None = None, render_mode: str | None = None) -> gymnasium.Env:
    """The game with its time limit."""
    return TimeLimit(AtariGame(id, settings, render_mode), episode_limit(settings, max_episode_steps))


class AtariGame(gymnasium.Env):
    """Observations ``uint8[H, W, stack]``, the newest frame last; older frames of a new game are black."""

    def __init__(self, id: str, settings: AtariSettings, render_mode: str | None = None) -> None:
        """Makes Gymnasium's environment of that id."""
        self.metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 15}
        self._raw = gymnasium.make(
            id,
            frameskip=1,
            repeat_action_probability=settings.repeat_action_probability,
            full_action_space=settings.full_action_space,
            max_num_frames_per_episode=0,
            render_mode=render_mode,
            disable_env_checker=True,
        )
        self._ale = self._raw.get_wrapper_attr("ale")
        self._actions = self._ale.getLegalActionSet() if settings.full_action_space else self._ale.getMinimalActionSet()
        self._settings = settings
        height, width = self._ale.getScreenDims()
        size = settings.screen_size
        self._rows, self._columns = area_weights(height, size), area_weights(width, size).T
        self._screens = np.zeros((2, height, width), np.uint8)
        self._frames: deque[np.ndarray] = deque(maxlen=settings.stack_num)
        self._lives = 0
        self.render_mode = render_mode
        self.frames_stacked = settings.stack_num
        self.observation_space = spaces.Box(0, 255, (size, size, settings.stack_num), np.uint8)
        self.action_space = spaces.Discrete(len(self._actions))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """A new game; without a seed, from this environment's own generators."""
        super().reset(seed=seed)
        self._raw.reset(seed=seed)
        self._begin()
        self._lives = self._ale.lives()
        self._screens[0] = 0
        self._ale.getScreenGrayscale(self._screens[1])
        black = np.zeros((self._settings.screen_size, self._settings.screen_size), np.uint8)
        self._frames.extend([black] * self._settings.stack_num)
        return self._seen(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """The action for ``frameskip`` frames, fewer where the game ends."""
        reward, chosen = 0.0, self._actions[int(action)]
        for left in range(self._settings.frameskip - 1, -1, -1):
            reward += self._ale.act(chosen)
            if self._ale.game_over(with_truncation=False):
                # ale-py's engine leaves the frames of a game that is over as they were.
                break
            if left < 2:
                self._ale.getScreenGrayscale(self._screens[1 - left])
        over, lives = self._ale.game_over(with_truncation=False), self._ale.lives()
        lost, self._lives = lives < self._lives and not over, lives
        info = {"cost": 1.0} if lost and self._settings.terminal_on_life_loss else {}
        return self._seen(), reward, over, False, info

    def render(self) -> np.ndarray | None:
        """The game's own picture ``uint8[210, 160, 3]``."""
        picture = self._raw.render()
        return picture if isinstance(picture, np.ndarray) else None

    def close(self) -> None:
        """Ends the game."""
        self._raw.close()

    def _begin(self) -> None:
        """Doing nothing and pressing FIRE, as the protocol says."""
        settings = self._settings
        fire = settings.use_fire_reset and FIRE in [int(action) for action in self._actions]
        frames = int(self.np_random.integers(1, settings.noop_max + 1)) if settings.noop_max else 0
        for _ in range(max(frames - fire, 0)):
            self._ale.act(NOOP)
            if self._ale.game_over():
                self._ale.reset_game()
        if fire:
            self._ale.act(FIRE)

    def _seen(self) -> np.ndarray:
        np.maximum(self._screens[0], self._screens[1], out=self._screens[0])
        small = self._rows @ (self._screens[0].astype(np.float32) @ self._columns)
        self._frames.append(np.rint(small).astype(np.uint8))
        return np.stack(self._frames, axis=-1)


def area_weights(length: int, parts: int) -> np.ndarray:
    """Averages over ``parts`` equal stretches of ``length`` pixels, ``float32[parts, length]``; rows add up to 1."""
    edges = np.arange(parts + 1) * (length / parts)
    pixel = np.arange(length)
    covered = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    return (np.maximum(covered, 0) / (length / parts)).astype(np.float32)
