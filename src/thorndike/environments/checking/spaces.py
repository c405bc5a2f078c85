"""Whether the spaces are there, are of a kind that can be learnt with, and have sane bounds."""

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import CannotGoOn, Findings
from thorndike.environments.host.arrays import PLAIN_SPACES

LARGEST_RANGE = 1e6
"""An action range above this is as good as endless."""
LEAST_SIDE = 0.01
"""Bounds on both sides of zero are lopsided if one is closer to it than this share of the other."""


def check_spaces(environment: gymnasium.Env, findings: Findings) -> None:
    """Both spaces. Raises CannotGoOn, with the finding added, if one is missing."""
    for name in ("observation_space", "action_space"):
        space = getattr(environment, name, None)
        if not isinstance(space, gymnasium.Space):
            findings.error(
                "space_missing",
                f"{name} is {'not set' if space is None else f'a {type(space).__name__}'}, but must be a gymnasium.spaces.Space",
                f"set self.{name} in __init__, for example to gymnasium.spaces.{'Box(-1, 1, (4,))' if name[0] == 'o' else 'Discrete(2)'}",
            )
            raise CannotGoOn
    _check_observation_space(environment.observation_space, "observation_space", findings)
    _check_action_space(environment.action_space, findings)


def _check_observation_space(space: gymnasium.Space, path: str, findings: Findings) -> None:
    match space:
        case spaces.Dict():
            for key, part in space.items():
                _check_observation_space(part, f"{path}[{key!r}]", findings)
        case spaces.Tuple():
            for number, part in enumerate(space):
                _check_observation_space(part, f"{path}[{number}]", findings)
        case _ if not isinstance(space, PLAIN_SPACES):
            findings.error(
                "unsupported_space",
                f"{path} is {type(space).__name__}: no learner here takes it",
                "turn it into Box, Discrete, MultiDiscrete, MultiBinary, or a Dict or Tuple of these, with a gymnasium wrapper",
                path,
            )


def _check_action_space(space: gymnasium.Space, findings: Findings) -> None:
    match space:
        case spaces.Box():
            _check_action_box(space, findings)
        case spaces.Discrete(n=1):
            findings.warning("single_action", "action_space is Discrete(1): there is nothing to choose", "give it the actions there are")
        case _ if not isinstance(space, PLAIN_SPACES):
            findings.error(
                "unsupported_space",
                f"action_space is {type(space).__name__}: no learner here takes it",
                "flatten it to Discrete, MultiDiscrete, MultiBinary or Box with a gymnasium wrapper",
                "action_space",
            )


def _check_action_box(space: spaces.Box, findings: Findings) -> None:
    if space.dtype.kind != "f":
        findings.warning(
            "action_dtype",
            f"action_space is a Box of {space.dtype}: learners choose floats, whose fractions are cut off",
            "use Discrete or MultiDiscrete for whole numbers, or a Box of np.float32",
        )
        return
    low, high = np.ravel(space.low).astype(np.float64), np.ravel(space.high).astype(np.float64)
    with np.errstate(over="ignore"):
        endless = np.flatnonzero(~(high - low < LARGEST_RANGE))
    if len(endless):
        first = endless[0]
        findings.warning(
            "action_bounds_endless",
            f"action_space: dimensions {_some(endless)} have no sensible bounds (dimension {first}: {low[first]:.3g} to {high[first]:.3g})",
            "give the range in which actions make a difference: learners act in [-1, 1], which is mapped to finite bounds only",
        )
    width = high - low
    still = np.flatnonzero(width == 0)
    if len(still):
        findings.warning(
            "action_bounds_empty",
            f"action_space: dimensions {_some(still)} allow one value only ({low[still[0]]:.3g})",
            "leave them out of the space, or widen their bounds",
        )
    lopsided = np.flatnonzero((low < 0) & (high > 0) & (np.minimum(-low, high) < LEAST_SIDE * np.maximum(-low, high)) & np.isfinite(width))
    if len(lopsided):
        first = lopsided[0]
        findings.hint(
            "action_bounds_lopsided",
            f"action_space: dimensions {_some(lopsided)} lie almost wholly on one side of zero (dimension {first}: {low[first]:.3g} "
            f"to {high[first]:.3g}), so an untrained policy acts near {(low[first] + high[first]) / 2:.3g}",
            "choose bounds whose middle is a harmless action, or start the range at zero",
        )


def _some(numbers: np.ndarray) -> str:
    """The first few of many."""
    shown = ", ".join(map(str, numbers[:8].tolist()))
    return f"[{shown}]" if len(numbers) <= 8 else f"[{shown}, ... {len(numbers)} in all]"
