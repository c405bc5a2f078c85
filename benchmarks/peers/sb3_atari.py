"""Pong as Stable-Baselines3 and SBX prepare it, for the task ``pong``: the protocol ``classic``, 8 games in one process.

``make_atari_env`` adds no-ops, frame skip 4 with the maximum of two, grey 84 x 84, the end of an episode at a lost life, FIRE, clipped
rewards; four frames are stacked.
"""

import ale_py
import gymnasium
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack

NUM_ENVS = 8


def pong(seed: int) -> VecEnv:
    """The 8 games."""
    gymnasium.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    return VecFrameStack(make_atari_env("PongNoFrameskip-v4", n_envs=NUM_ENVS, seed=seed), n_stack=4)
