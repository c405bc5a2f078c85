"""Native environments: compiled JAX dynamics, equal to Gymnasium's step by step; nothing heavy is imported before one is asked for."""

import importlib
from collections.abc import Callable, Mapping
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


def factory(id: str) -> "Callable[..., Dynamics]":
    """The factory of a native environment's dynamics; it takes Gymnasium's settings by keyword. Raises UserError if there is none."""
    if id not in NATIVE:
        raise UserError(f"{id!r} has no native engine: expected one of {', '.join(NATIVE)}; other environments run on a host engine")
    module, name = NATIVE[id].split(":")
    return getattr(importlib.import_module(module), name)
