"""Atari games in ale-py's own C++ threads (``AtariVectorEnv``), preprocessed there, as a host engine.

What ale-py 0.12.1 does, and what this engine makes of it (each found by a test in tests/environments/test_atari.py):

* ``SAME_STEP``: an ended game is reset in the step that ends it, and ``infos["final_obs"]`` is the observation before the reset: no row is
  dead. Its ``DISABLED`` mode does not exist.
* Frames are channels first and older frames of a new game are black: shown here as ``[84, 84, 4]``, the newest last.
* In the step of its time limit the last observation lacks the frames of that step, and whether a life was lost is not told: the limit is
  kept here, with a reset by mask in the same step.
* With a life lost it would either end the game for itself or say nothing: lives are counted here, so that returns are whole games'.
"""

import os
from collections.abc import Sequence

import numpy as np
from ale_py.vector_env import AtariVectorEnv
from gymnasium import spaces
from gymnasium.vector import AutoresetMode

from thorndike.environments.host.arrays import check_seeds
from thorndike.environments.host.atari import AtariSettings, episode_limit, rom_name
from thorndike.environments.host.steps import host_spec, host_step
from thorndike.types import Step

_NO_LIMIT = 2**31 - 1


class AleEngine:
    """``num_envs`` games of one id, stepped by C++ threads."""

    def __init__(self, id: str, num_envs: int, settings: AtariSettings, max_episode_steps: int | None = None) -> None:
        """Makes the games."""
        limit = episode_limit(settings, max_episode_steps)
        size = settings.screen_size
        self._vector = AtariVectorEnv(
            rom_name(id),
            num_envs,
            num_threads=min(num_envs, len(os.sched_getaffinity(0))),
            max_num_frames_per_episode=_NO_LIMIT,
            repeat_action_probability=float(settings.repeat_action_probability),
            full_action_space=settings.full_action_space,
            autoreset_mode=AutoresetMode.SAME_STEP,
            img_height=size,
            img_width=size,
            stack_num=settings.stack_num,
            frameskip=settings.frameskip,
            noop_max=settings.noop_max,
            use_fire_reset=settings.use_fire_reset,
            reward_clipping=False,
        )
        space = spaces.Box(0, 255, (size, size, settings.stack_num), np.uint8)
        action = self._vector.single_action_space
        self.spec = host_spec(id, space, action, num_envs, limit, "ale")._replace(frames=settings.stack_num)
        self._limit, self._tells_lives = limit, settings.terminal_on_life_loss
        self._lives, self._clock = np.zeros((2, num_envs), np.int32)
        self._valid = np.ones(num_envs, np.bool_)
        self._valid.setflags(write=False)

    def reset(self, seeds: Sequence[int]) -> np.ndarray:
        """Every game from its own seed (its low 31 bits): obs ``[B, H, W, stack]``."""
        seeds = [seed % 2**31 for seed in check_seeds(seeds, self.spec.num_envs)]
        obs, infos = self._vector.reset(seed=np.asarray(seeds, np.int64))
        self._lives, self._clock = infos["lives"].copy(), np.zeros_like(self._clock)
        return _channels_last(obs)

    def step(self, actions: np.ndarray) -> Step:
        """One action each, ``int[B]`` -> Step of fresh arrays ``[B, ...]``; rewards are the game's own."""
        batch, reward, terminated, _, infos = self._vector.step(np.asarray(actions, np.int32))
        terminated = np.array(terminated, np.bool_)
        self._clock += 1
        truncated = self._clock >= self._limit
        obs = next_obs = _channels_last(batch)
        lives = infos["lives"]
        lost = (lives < self._lives) & ~terminated if self._tells_lives else np.zeros_like(terminated)
        if terminated.any():
            next_obs = obs.copy()
            next_obs[terminated] = _channels_last(infos["final_obs"][terminated])
        cut = truncated & ~terminated
        if cut.any():
            obs = obs.copy()
            obs[cut], lives = self._begin_again(cut)
        self._clock[terminated | truncated] = 0
        self._lives = lives.copy()
        return host_step(
            obs,
            next_obs,
            reward=reward.astype(np.float32),
            cost=lost.astype(np.float32),
            terminated=terminated,
            truncated=truncated,
            valid=self._valid,
        )

    def _begin_again(self, cut: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """New games where a limit cut the old ones: their first observations, and the lives of all."""
        fresh, infos = self._vector.reset(options={"reset_mask": cut})
        return _channels_last(fresh[cut]), infos["lives"]

    def close(self) -> None:
        """Ends the games."""
        self._vector.close()


def _channels_last(frames: np.ndarray) -> np.ndarray:
    """Stacks ``[B, stack, H, W]`` as fresh ``[B, H, W, stack]``."""
    return np.moveaxis(frames, 1, -1).copy(order="C")
