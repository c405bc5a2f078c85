"""Masks that an environment gives beside its observations, moved into them: where learners look for them.

Three conventions are read: ``obs["action_mask"]`` (needs nothing here), ``info["action_mask"]`` (Gymnasium's Taxi, PettingZoo) and a method
``action_masks()`` (Stable-Baselines3's MaskablePPO). Moved into the observation, a mask is right at the true last observation of an episode
too, under every autoreset mode, and travels with observations through replay and rollouts.
"""

from collections.abc import Callable

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.errors import UserError

MASK = "action_mask"


class MaskInObservation(gymnasium.Wrapper):
    """Observations become ``{"observation": obs, "action_mask": mask}``; of a Dict space, the mask is one more entry."""

    def __init__(self, env: gymnasium.Env, size: int, from_method: bool) -> None:
        """``size`` is the number of entries of a mask; ``from_method`` says which of the two conventions is used."""
        super().__init__(env)
        self._from_method, self._size = from_method, size
        inner = env.observation_space
        parts = dict(inner.spaces) if isinstance(inner, spaces.Dict) else {"observation": inner}
        self.observation_space = spaces.Dict(parts | {MASK: spaces.MultiBinary(size)})

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """The first observation, with its mask."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self._shown(obs, info), info

    def step(self, action: object) -> tuple[dict, float, bool, bool, dict]:
        """One step; the observation comes with the mask of the next action."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._shown(obs, info), float(reward), terminated, truncated, info

    def _shown(self, obs: object, info: dict) -> dict:
        parts = dict(obs) if isinstance(self.env.observation_space, spaces.Dict) and isinstance(obs, dict) else {"observation": obs}
        mask = self.env.get_wrapper_attr("action_masks")() if self._from_method else info.get(MASK)
        mask = np.ones(self._size, np.int8) if mask is None else _flat(mask)
        if mask.shape != (self._size,):
            raise UserError(f"the action mask has {mask.size} entries, but had {self._size} at first: give one entry an action, always")
        return parts | {MASK: mask}


def mask_in_observation(make: Callable[..., gymnasium.Env]) -> Callable[..., gymnasium.Env]:
    """``make`` itself where there is no mask or it is in the observation already, else a function that moves it there.

    One environment is made and reset to find out.
    """
    env = make()
    try:
        if isinstance(env.observation_space, spaces.Dict) and MASK in env.observation_space.spaces:
            return make
        from_method = env.has_wrapper_attr("action_masks")
        _, info = env.reset(seed=0)
        mask = env.get_wrapper_attr("action_masks")() if from_method else info.get(MASK)
    finally:
        env.close()
    if mask is None:
        return make
    return _Masked(make, _flat(mask).size, from_method)


class _Masked:
    """A maker of wrapped environments, a class so that it can be sent to a worker process."""

    def __init__(self, make: Callable[..., gymnasium.Env], size: int, from_method: bool) -> None:
        self._make, self._size, self._from_method = make, size, from_method

    def __call__(self, render_mode: str | None = None) -> gymnasium.Env:
        env = self._make() if render_mode is None else self._make(render_mode=render_mode)
        return MaskInObservation(env, self._size, self._from_method)


def _flat(mask: object) -> np.ndarray:
    """One row of 0 and 1; MultiDiscrete masks given as a tuple of rows are put one after another."""
    rows = mask if isinstance(mask, tuple | list) and mask and np.ndim(mask[0]) else [mask]
    return np.concatenate([np.ravel(np.asarray(row)) for row in rows]).astype(np.int8)
