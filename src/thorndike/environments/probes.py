"""Probe environments: tasks so small that the right values are known, each of which only a certain mistake gets wrong.

After A. Jones, "Debugging Reinforcement Learning Systems" (2021), with three of our own: the time limit, the scale of rewards, the
counting environment. ``PROBES`` lists each with its right values and actions, for a Discrete and a Box action, so that one test can ask
them of every learner. A learner passes where ``|V - values| <= 0.05`` (times ``scale``) and the best action has a probability of 0.95.

Observation: ``float32[..., 1]``. Discrete actions are 0 and 1; Box actions are within 1.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.randomness import draw_words, no_noise
from thorndike.environments.native.vectorize import Dynamics
from thorndike.types import Action, Noise

Signal: TypeAlias = Float[Array, "*batch"]
Reward: TypeAlias = Callable[[Signal, Action], Float[Array, "*batch"]]

TIME_LIMIT = 10
OFFSET = 1e4
BEST_FORCE = 0.5
"""The best Box action of the action probes, by the sign of the observation in the second."""


class Probe(NamedTuple):
    """A probe environment and what a right learner ends with."""

    id: str
    catches: str
    """The mistake it shows."""
    observations: tuple[float, ...]
    """Every observation that a decision is taken on."""
    values: tuple[float, ...]
    """V of the best policy, by observation."""
    actions: tuple[float, ...] | None
    """The best action by observation; None where none is better."""
    action_values: tuple[tuple[float, float], ...] | None
    """Q of the best policy, by observation and action; None for Box actions."""
    gamma: float = 0.9
    scale: float = 1.0
    """The size of rewards: the tolerance's unit. Other than 1: the learner must normalise observations and rewards."""


def _probe(
    id: str,
    reward: Reward,
    *,
    continuous: bool,
    random_start: bool = False,
    ends: bool | None = True,
    limit: int | None = None,
    offset: float = 0.0,
) -> Dynamics:
    """The dynamics of a probe whose state is one number, its signal.

    ``random_start``: the signal is -1 or 1, else it starts at 0 and is 1 from the second step. ``ends``: after every step, never (False),
    or after a step from signal 1 (None).
    """

    def reset(noise: Noise) -> Signal:
        return _sign(noise) if random_start else jnp.float32(0)

    def step(signal: Signal, action: Action, noise: Noise) -> tuple[Signal, Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del noise
        terminated = signal > 0.5 if ends is None else jnp.full_like(signal, ends, jnp.bool_)
        return signal if random_start else jnp.ones_like(signal), reward(signal, action), terminated

    return Dynamics(
        reset=reset,
        observe=lambda signal: signal[..., None] + jnp.float32(offset),
        step=step,
        draw_reset=draw_words if random_start else no_noise,
        draw_step=no_noise,
        observation_space=spaces.Box(offset - 1, offset + 1, (1,), np.float32),
        action_space=spaces.Box(-1.0, 1.0, (1,), np.float32) if continuous else spaces.Discrete(2),
        id=_name(id, continuous),
        max_episode_steps=limit,
    )


def constant_reward(*, continuous: bool = False) -> Dynamics:
    """One step, reward 1 whatever happens: the value function learns a constant."""
    return _probe("ConstantReward", lambda signal, action: jnp.ones_like(signal), continuous=continuous)


def observed_reward(*, continuous: bool = False) -> Dynamics:
    """One step, the reward is the observation, -1 or 1: the value function uses it."""
    return _probe("ObservedReward", lambda signal, action: signal, continuous=continuous, random_start=True)


def delayed_reward(*, continuous: bool = False) -> Dynamics:
    """Two steps, reward 1 at the second: rewards are discounted back."""
    return _probe("DelayedReward", lambda signal, action: signal, continuous=continuous, ends=None)


def action_choice(*, continuous: bool = False) -> Dynamics:
    """One step, the reward depends on the action alone: the policy improves."""
    return _probe("ActionChoice", functools.partial(_action_reward, follow=False), continuous=continuous)


def observation_to_action(*, continuous: bool = False) -> Dynamics:
    """One step, the right action depends on the observation: the policy uses it."""
    reward = functools.partial(_action_reward, follow=True)
    return _probe("ObservationToAction", reward, continuous=continuous, random_start=True)


def time_limit(*, continuous: bool = False) -> Dynamics:
    """Reward 0 from the first observation, then 1 a step for ever, cut after 10 steps: a limit is no death.

    At gamma 0.9, V(1) is 10. Treated as death it is 5.00, bootstrapped from the observation after the reset 9.09.
    """
    return _probe("TimeLimit", lambda signal, action: signal, continuous=continuous, ends=False, limit=TIME_LIMIT)


def reward_scale(*, scale: float, name: str, continuous: bool = False) -> Dynamics:
    """``observation_to_action`` with rewards times ``scale`` and observations shifted by 10,000: normalisation makes up for both."""

    def reward(signal: Signal, action: Action) -> Float[Array, "*batch"]:
        return jnp.float32(scale) * _action_reward(signal, action, follow=True)

    return _probe(name, reward, continuous=continuous, random_start=True, offset=OFFSET)


def counting(*, length: int = 7, max_episode_steps: int | None = None) -> Dynamics:
    """Counts its steps: observation ``n`` is followed by ``n + 1``, terminated at ``length``, whatever the action; the reward is ``n + 1``.

    A transition stored with another successor is false: it comes from an automatic reset that was taken for a step.
    """

    def step(
        count: Int32[Array, "*batch"], action: Action, noise: Noise
    ) -> tuple[Int32[Array, "*batch"], Float[Array, "*batch"], Bool[Array, "*batch"]]:
        del action, noise
        after = count + 1
        return after, after.astype(jnp.float32), after >= length

    return Dynamics(
        reset=lambda noise: jnp.int32(0),
        observe=lambda count: count[..., None].astype(jnp.float32),
        step=step,
        draw_reset=no_noise,
        draw_step=no_noise,
        observation_space=spaces.Box(0.0, float(length), (1,), np.float32),
        action_space=spaces.Discrete(2),
        id="probe/Counting-v0",
        max_episode_steps=max_episode_steps,
    )


constant_reward_continuous = functools.partial(constant_reward, continuous=True)
observed_reward_continuous = functools.partial(observed_reward, continuous=True)
delayed_reward_continuous = functools.partial(delayed_reward, continuous=True)
action_choice_continuous = functools.partial(action_choice, continuous=True)
observation_to_action_continuous = functools.partial(observation_to_action, continuous=True)
time_limit_continuous = functools.partial(time_limit, continuous=True)
reward_scale_large = functools.partial(reward_scale, scale=1e6, name="RewardScaleLarge")
reward_scale_large_continuous = functools.partial(reward_scale_large, continuous=True)
reward_scale_small = functools.partial(reward_scale, scale=1e-6, name="RewardScaleSmall")
reward_scale_small_continuous = functools.partial(reward_scale_small, continuous=True)


def _action_reward(signal: Signal, action: Action, *, follow: bool) -> Float[Array, "*batch"]:
    """Discrete: 1 for the right action (1, or with ``follow`` 1 where the signal is positive), else -1. Box: 1 - the squared error."""
    if not jnp.issubdtype(action.dtype, jnp.floating):
        right = (action == 1) == (signal > 0) if follow else action == 1
        return jnp.where(right, jnp.float32(1), jnp.float32(-1))
    best = BEST_FORCE * signal if follow else jnp.full_like(signal, BEST_FORCE)
    return 1 - jnp.square(action[..., 0] - best)


def _sign(words: UInt32[Array, "*batch"]) -> Signal:
    """-1 or 1, each half of the time."""
    return (words >> 31).astype(jnp.float32) * 2 - 1


def _name(id: str, continuous: bool) -> str:
    """The environment's id."""
    return f"probe/{id}{'Continuous' if continuous else ''}-v0"


def _both(
    id: str,
    catches: str,
    observations: tuple[float, ...],
    values: tuple[float, ...],
    action_values: tuple[tuple[float, float], ...],
    best_force: tuple[float, ...] | None = None,
    scale: float = 1.0,
) -> tuple[Probe, Probe]:
    """The probe with Discrete and with Box actions."""
    best_action = None if best_force is None else tuple(float(right > left) for left, right in action_values)
    discrete = Probe(_name(id, False), catches, observations, values, best_action, action_values, scale=scale)
    return discrete, discrete._replace(id=_name(id, True), actions=best_force, action_values=None)


PROBES: tuple[Probe, ...] = (
    *_both("ConstantReward", "the value loss or its optimiser", (0.0,), (1.0,), ((1.0, 1.0),)),
    *_both("ObservedReward", "the value network's gradient", (-1.0, 1.0), (-1.0, 1.0), ((-1.0, -1.0), (1.0, 1.0))),
    *_both("DelayedReward", "discounting", (0.0, 1.0), (0.9, 1.0), ((0.9, 0.9), (1.0, 1.0))),
    *_both("ActionChoice", "advantages or the policy loss", (0.0,), (1.0,), ((-1.0, 1.0),), (BEST_FORCE,)),
    *_both(
        "ObservationToAction",
        "the batching of observations, actions and returns",
        (-1.0, 1.0),
        (1.0, 1.0),
        ((1.0, -1.0), (-1.0, 1.0)),
        (-BEST_FORCE, BEST_FORCE),
    ),
    *_both("TimeLimit", "truncation taken for death, or bootstrapped after the reset", (0.0, 1.0), (9.0, 10.0), ((9.0, 9.0), (10.0, 10.0))),
    *_both(
        "RewardScaleLarge",
        "the normalisation of observations and large rewards",
        (OFFSET - 1, OFFSET + 1),
        (1e6, 1e6),
        ((1e6, -1e6), (-1e6, 1e6)),
        (-BEST_FORCE, BEST_FORCE),
        1e6,
    ),
    *_both(
        "RewardScaleSmall",
        "the normalisation of observations and small rewards",
        (OFFSET - 1, OFFSET + 1),
        (1e-6, 1e-6),
        ((1e-6, -1e-6), (-1e-6, 1e-6)),
        (-BEST_FORCE, BEST_FORCE),
        1e-6,
    ),
)
"""Every probe that has right values, once with a Discrete and once with a Box action."""
