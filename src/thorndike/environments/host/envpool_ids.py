"""Which ids EnvPool has, read from a list beside this file: importing EnvPool takes seconds and brings JAX.

Parity with Gymnasium 1.4.0 and MuJoCo 4.0, measured on EnvPool 1.2.5. From the same states with the same actions, 173 to 200 steps each,
largest difference of a reward: HalfCheetah-v5 7e-8, Hopper-v5 1e-7, Swimmer-v5 5e-8, InvertedPendulum-v5 0, Pendulum-v1 3e-6, and no flag
differs (observations 4e-9 or less in the median dimension; float32 in Pendulum). Ant, Humanoid, HumanoidStandup, InvertedDoublePendulum,
Pusher, Reacher and Walker2d (all v5), LunarLanderContinuous-v3 and BipedalWalkerHardcore-v3: the same spaces and limits and, with random
actions, close mean rewards, and episode lengths within two standard errors. (Walker2d shows clipped speeds, so its state cannot be set.)
The same policies: LunarLander-v3 with Gymnasium's heuristic, 160 episodes, 241.3 +- 7.6 in EnvPool and 245.2 +- 7.8 in Gymnasium;
BipedalWalker-v3 with its heuristic, 64 episodes, 55 +- 16 and 40 +- 16. tests/environments/test_host_engines.py repeats the step-by-step
comparison for ids whose whole state is in the observation.

Never chosen by itself: CarRacing-v3 and v2 to v4 of MuJoCo, which were not compared enough, and Atari, which is another task: EnvPool's
``Pong-v5`` is preprocessed (4 grey frames of 84 x 84, no sticky actions), Gymnasium's ``ALE/Pong-v5`` is not.
"""

import importlib.util
from functools import cache
from importlib import resources

SAME_AS_GYMNASIUM = frozenset(
    [f"{name}-v3" for name in ("LunarLander", "LunarLanderContinuous", "BipedalWalker", "BipedalWalkerHardcore")]
    + [f"{name}-v5" for name in ("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum")]
    + [f"{name}-v5" for name in ("InvertedPendulum", "Pusher", "Reacher", "Swimmer", "Walker2d")]
)
"""Ids that mean the same task in EnvPool and in Gymnasium, by the comparison above."""


@cache
def pool_ids() -> frozenset[str]:
    """Every id of EnvPool 1.2.5, installed or not."""
    return frozenset(resources.files(__package__).joinpath("envpool_ids.txt").read_text().split())


def pool_is_installed() -> bool:
    """Whether ``import envpool`` would find it."""
    return importlib.util.find_spec("envpool") is not None
