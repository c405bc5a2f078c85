"""What a host environment rewards and ends for, by its goals, as pure functions that a compiled replay can call.

Gymnasium-robotics' convention: ``compute_reward(achieved_goal, desired_goal, info)`` and, if goals end episodes, ``compute_terminated``
with the same arguments. Both run in Python, where a compiled program cannot go at every gradient step. So what they compute is *found*: a
function of the distance among those that such environments use, or theirs itself if JAX can trace it (written with jax.numpy or plain
operators). Whatever is found has been compared with the environment's own answers on goals near and far; else there is no ``Goal``.

``info`` is empty here: a reward that needs more than the goals is not found. Distances within a ten-thousandth of a threshold may be
judged differently, because goals are float32.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeAlias

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from thorndike.types import Goal

Judge: TypeAlias = Callable[[Array, Array], Array]
SAMPLES = 64
MAZE_THRESHOLD = 0.45
"""Gymnasium-robotics' mazes have it in their code, not in an attribute."""


def find_goal(environment: gymnasium.Env) -> Goal | None:
    """How ``environment`` judges goals; None if it has none, or if no pure function is known to judge as it does."""
    space, inner = environment.observation_space, environment.unwrapped
    compute_reward = getattr(inner, "compute_reward", None)
    if not isinstance(space, gymnasium.spaces.Dict) or compute_reward is None:
        return None
    wanted = space.spaces.get("desired_goal")
    if not isinstance(wanted, gymnasium.spaces.Box) or len(wanted.shape) != 1 or "achieved_goal" not in space.spaces:
        return None
    threshold = float(getattr(inner, "distance_threshold", MAZE_THRESHOLD))
    goals = _made_up_goals(wanted.shape[0], threshold)
    reward = _found(compute_reward, [*_rewards(threshold), _traced(compute_reward)], goals)
    compute_terminated = getattr(inner, "compute_terminated", None)
    ends = [_never, lambda achieved, desired: _distance(achieved, desired) <= threshold]
    terminated = _never if compute_terminated is None else _found(compute_terminated, [*ends, _traced(compute_terminated)], goals)
    if reward is None or terminated is None:
        return None
    return Goal(lambda a, d: reward(a, d).astype(jnp.float32), lambda a, d: terminated(a, d).astype(bool))


def _rewards(threshold: float) -> list[Judge]:
    """Sparse and dense, of the robots and of the mazes."""
    return [
        lambda achieved, desired: -(_distance(achieved, desired) > threshold).astype(jnp.float32),
        lambda achieved, desired: -_distance(achieved, desired),
        lambda achieved, desired: (_distance(achieved, desired) <= threshold).astype(jnp.float32),
        lambda achieved, desired: jnp.exp(-_distance(achieved, desired)),
    ]


def _distance(achieved: Array, desired: Array) -> Array:
    return jnp.linalg.norm(achieved - desired, axis=-1)


def _never(achieved: Array, desired: Array) -> Array:
    del desired
    return jnp.zeros(achieved.shape[:-1], bool)


def _traced(function: Callable) -> Judge:
    return lambda achieved, desired: jnp.asarray(function(achieved, desired, {}))


def _made_up_goals(size: int, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Achieved and desired goals ``[SAMPLES, size]``, equal, near each other and far apart, none of them at the threshold."""
    rng = np.random.default_rng(0)
    desired, way = rng.normal(size=(2, SAMPLES, size))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    radius = np.concatenate([[0.0, 0.99, 1.01], rng.uniform(0.0, 3.0, SAMPLES // 2), rng.uniform(0.0, 100.0, SAMPLES // 2 - 3)]) * threshold
    radius[np.abs(radius - threshold) < 1e-3 * threshold] = 0.0
    return (desired + radius[:, None] * way).astype(np.float32), desired.astype(np.float32)


def _found(theirs: Callable, candidates: Sequence[Judge], goals: tuple[np.ndarray, np.ndarray]) -> Judge | None:
    """The first candidate that answers as ``theirs`` does, one pair of goals after another."""
    achieved, desired = goals
    answers = _answers(lambda: np.array([theirs(a, d, {}) for a, d in zip(achieved, desired, strict=True)], np.float64))
    if answers is None or answers.shape != (len(achieved),):
        return None
    for candidate in candidates:
        said = _answers(partial(_said, candidate, achieved, desired))
        if said is not None and said.shape == answers.shape and np.allclose(said, answers, rtol=1e-3, atol=1e-4):
            return candidate
    return None


def _said(candidate: Judge, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    return np.asarray(jax.jit(candidate)(achieved, desired), np.float64)


def _answers(ask: Callable[[], np.ndarray]) -> np.ndarray | None:
    try:
        return ask()
    # A user's function may raise anything where it needs more than goals, or is traced: then it is not one that can be used here.
    except Exception:
        return None
