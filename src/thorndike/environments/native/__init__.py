"""Native environments: compiled JAX dynamics, equal to Gymnasium's step by step; nothing heavy is imported before one is asked for."""

import ast
import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from thorndike.errors import UserError

if TYPE_CHECKING:
    from thorndike.environments.native.vectorize import Dynamics

NATIVE: Mapping[str, str] = MappingProxyType(
    {
        "CartPole-v1": "thorndike.environments.native.cartpole:cartpole",
        "Acrobot-v1": "thorndike.environments.native.acrobot:acrobot",
        "MountainCar-v0": "thorndike.environments.native.mountain_car:mountain_car",
        "MountainCarContinuous-v0": "thorndike.environments.native.mountain_car:mountain_car_continuous",
        "Pendulum-v1": "thorndike.environments.native.pendulum:pendulum",
        "Blackjack-v1": "thorndike.environments.native.blackjack:blackjack",
        "DeepSea-v0": "thorndike.environments.native.deep_sea:deep_sea",
        "BitFlip-v0": "thorndike.environments.native.bit_flip:bit_flip",
        "MinAtar/Asterix-v0": "thorndike.environments.native.minatar.asterix:asterix",
        "MinAtar/Asterix-v1": "thorndike.environments.native.minatar.asterix:asterix_minimal",
        "MinAtar/Breakout-v0": "thorndike.environments.native.minatar.breakout:breakout",
        "MinAtar/Breakout-v1": "thorndike.environments.native.minatar.breakout:breakout_minimal",
        "MinAtar/Freeway-v0": "thorndike.environments.native.minatar.freeway:freeway",
        "MinAtar/Freeway-v1": "thorndike.environments.native.minatar.freeway:freeway_minimal",
        "MinAtar/Seaquest-v0": "thorndike.environments.native.minatar.seaquest:seaquest",
        "MinAtar/Seaquest-v1": "thorndike.environments.native.minatar.seaquest:seaquest_minimal",
        "MinAtar/SpaceInvaders-v0": "thorndike.environments.native.minatar.space_invaders:space_invaders",
        "MinAtar/SpaceInvaders-v1": "thorndike.environments.native.minatar.space_invaders:space_invaders_minimal",
        "probe/ConstantReward-v0": "thorndike.environments.probes:constant_reward",
        "probe/ConstantRewardContinuous-v0": "thorndike.environments.probes:constant_reward_continuous",
        "probe/ObservedReward-v0": "thorndike.environments.probes:observed_reward",
        "probe/ObservedRewardContinuous-v0": "thorndike.environments.probes:observed_reward_continuous",
        "probe/DelayedReward-v0": "thorndike.environments.probes:delayed_reward",
        "probe/DelayedRewardContinuous-v0": "thorndike.environments.probes:delayed_reward_continuous",
        "probe/ActionChoice-v0": "thorndike.environments.probes:action_choice",
        "probe/ActionChoiceContinuous-v0": "thorndike.environments.probes:action_choice_continuous",
        "probe/ObservationToAction-v0": "thorndike.environments.probes:observation_to_action",
        "probe/ObservationToActionContinuous-v0": "thorndike.environments.probes:observation_to_action_continuous",
        "probe/TimeLimit-v0": "thorndike.environments.probes:time_limit",
        "probe/TimeLimitContinuous-v0": "thorndike.environments.probes:time_limit_continuous",
        "probe/RewardScaleLarge-v0": "thorndike.environments.probes:reward_scale_large",
        "probe/RewardScaleLargeContinuous-v0": "thorndike.environments.probes:reward_scale_large_continuous",
        "probe/RewardScaleSmall-v0": "thorndike.environments.probes:reward_scale_small",
        "probe/RewardScaleSmallContinuous-v0": "thorndike.environments.probes:reward_scale_small_continuous",
        "probe/Counting-v0": "thorndike.environments.probes:counting",
    }
)
"""Environment id -> ``module:factory``. A factory takes Gymnasium's own settings of that environment, by keyword."""


def is_only_native(id: str) -> bool:
    """Whether a native environment exists nowhere else."""
    return id in NATIVE and (id.startswith("probe/") or id == "BitFlip-v0")


def factory(id: str) -> "Callable[..., Dynamics]":
    """The factory of a native environment's dynamics; it takes Gymnasium's settings by keyword. Raises UserError if there is none."""
    if id not in NATIVE:
        raise UserError(f"{id!r} has no native engine: expected one of {', '.join(NATIVE)}; other environments run on a host engine")
    module, name = NATIVE[id].split(":")
    return getattr(importlib.import_module(module), name)


def settings_of(id: str) -> frozenset[str]:
    """The settings that a native environment can have at most, read from the text of its file: importing that brings JAX."""
    module, _ = NATIVE[id].split(":")
    path = Path(__file__).parents[2].joinpath(*module.split(".")[1:]).with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return frozenset(each.arg for node in tree.body if isinstance(node, ast.FunctionDef) for each in node.args.kwonlyargs)
