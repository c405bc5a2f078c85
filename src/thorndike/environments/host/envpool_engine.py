"""EnvPool's C++ thread pool as a host engine (Weng et al. 2022, arXiv:2206.10558).

What EnvPool 1.2.5 does, and what this engine makes of it (each found by a test here, not in its manual):

* It resets an ended environment in the step after: that row is reported with ``valid=False``.
* Seeds are fixed when a pool is made (``seed=[one each]``), so ``reset`` makes the pool anew.
* It reports ``terminated = done and not truncated``: a death in the very step of the time limit is lost, and a learner would go on
  valuing a dead state. For ids it shares with Gymnasium the pool therefore gets a limit one step later, and the limit itself is kept
  here, with a reset by mask in the same step: such a step has both flags, as in Gymnasium. For ids of its own, whose rewards may
  depend on the limit (MiniGrid's do), EnvPool keeps it.
* Its Box2D observation spaces have ``low = 1.2e-38`` where minus infinity is meant: Gymnasium's spaces are shown, or mended ones.
* Its images are channels first: small-channel uint8 images are turned to height, width, channels.
* It checks nothing it gives: what is not finite, an observation or a reward, is named in a UserError here, in the step where it is.

Which ids mean the same task as Gymnasium's, and how that was found, is in ``envpool_ids.py``.
"""

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.host.arrays import action_converter, check_seeds, check_spaces, fresh_copy, take, with_rows
from thorndike.environments.host.checks import all_finite, finite_test, not_finite, reward_not_finite
from thorndike.environments.host.faults import Fault, named, one_line, reset_name
from thorndike.environments.host.steps import host_step
from thorndike.errors import UserError
from thorndike.types import EnvSpec, Observation, Step

if TYPE_CHECKING:
    from envpool import GymnasiumEnvPool

NO_SETTINGS: Mapping[str, object] = MappingProxyType({})


class EnvPoolEngine:
    """A pool of ``num_envs`` environments of one EnvPool id, stepped by C++ threads."""

    def __init__(
        self,
        id: str,
        num_envs: int,
        *,
        reference: gymnasium.Env | None = None,
        max_episode_steps: int | None = None,
        env_kwargs: Mapping[str, object] = NO_SETTINGS,
        num_threads: int | None = None,
        pool_id: str | None = None,
        tells_lives: bool = False,
    ) -> None:
        """Describes the pool; it is made by ``reset``, because its seeds are fixed then.

        `reference` is Gymnasium's environment of that id, where there is one: its spaces and its limit are taken. `num_threads` defaults to
        the number of cores this process may use. `pool_id` is EnvPool's own name, where it is another; with `tells_lives` a lost life of
        an Atari game is its step's cost. Raises UserError for an id with several players or spaces no learner can be shown.
        """
        self._pool_id = pool_id or id
        own = _pool_facts(self._pool_id, env_kwargs)
        shown = own if reference is None else _shown(own, reference)
        observation, action = shown.observation, shown.action
        check_spaces(observation, action, id)
        limit = shown.limit if max_episode_steps is None else max_episode_steps
        self.spec = EnvSpec(id, observation, action, num_envs, limit, "envpool", frames=own.frames)
        self._limit = None if reference is None else limit
        self._settings = dict(env_kwargs)
        if limit is not None:
            self._settings["max_episode_steps"] = limit if self._limit is None else limit + 1
        self._channels_first = own.channels_first
        self._tells_lives = tells_lives
        self._convert = action_converter(action)
        self._is_finite = finite_test(observation)
        self._steps = 0
        self._threads = num_threads or min(num_envs, len(os.sched_getaffinity(0)))
        self._pool: GymnasiumEnvPool | None = None

    def reset(self, seeds: Sequence[int]) -> Observation:
        """A new pool, every environment from its own seed (its low 31 bits): obs ``[B, ...]``."""
        import envpool

        seeds = [seed % 2**31 for seed in check_seeds(seeds, self.spec.num_envs)]
        # The old pool's threads end only when it is collected, so it must go before the new one starts its own.
        self._pool = None
        self._ended = np.zeros(self.spec.num_envs, np.bool_)
        self._clock = np.zeros(self.spec.num_envs, np.int64)
        with _no_narrowing_warnings():
            pool = envpool.make_gymnasium(
                self._pool_id, num_envs=self.spec.num_envs, seed=seeds, num_threads=self._threads, **self._settings
            )
            observation, info = pool.reset()
        self._pool, self._lives = pool, np.array(info.get("lives", 0))
        obs = self._observed(observation)
        self._check_finite(obs, reset_name(self._steps))
        return obs

    def step(self, actions: np.ndarray) -> Step:
        """One action each: ``int[B]``, ``int[B, K]`` or ``float[B, D]`` (clipped to the bounds) -> Step of fresh arrays ``[B, ...]``.

        Raises UserError if an observation or a reward is not finite.
        """
        self._steps += 1
        observation, reward, terminated, truncated, info = self._running_pool().step(self._convert(actions))
        valid = ~self._ended
        next_obs = self._observed(observation)
        terminated, truncated = np.asarray(terminated, np.bool_) & valid, np.asarray(truncated, np.bool_) & valid
        # From here a row that EnvPool itself ended is dead in the next step; one that the limit below ends is not.
        self._ended = terminated | truncated
        obs, truncated = self._keep_limit(next_obs, terminated, truncated, valid)
        cost = np.where(valid, self._lost(info) if self._tells_lives else info.get("cost", 0), 0).astype(np.float32)
        reward = np.where(valid, reward, 0).astype(np.float32)
        self._check_finite(next_obs, f"step {self._steps}")
        if not all_finite(reward):
            raise self._named(reward_not_finite(reward), f"step {self._steps}")
        if obs is not next_obs:
            self._check_finite(obs, reset_name(self._steps))
        return host_step(obs, next_obs, reward=reward, cost=cost, terminated=terminated, truncated=truncated, valid=valid)

    def render(self) -> np.ndarray | None:
        """Pictures ``uint8[1, H, W, 3]`` of the first environment, where the settings have a ``render_mode``."""
        return self._running_pool().render()

    def close(self) -> None:
        """Ends the pool and its threads."""
        self._pool = None

    def _keep_limit(
        self, next_obs: Observation, terminated: np.ndarray, truncated: np.ndarray, valid: np.ndarray
    ) -> tuple[Observation, np.ndarray]:
        """Truncates at the limit kept here, where there is one, and resets what did not end by itself: next input, truncated."""
        if self._limit is None:
            return next_obs, truncated
        self._clock = np.where(valid, self._clock + 1, 0)
        truncated = truncated | (valid & (self._clock >= self._limit))
        cut = np.flatnonzero(truncated & ~self._ended).astype(np.int32)
        self._clock[truncated | terminated] = 0
        if cut.size == 0:
            return next_obs, truncated
        fresh, _ = self._running_pool().reset(cut)
        return with_rows(next_obs, cut, self._observed(fresh)), truncated

    def _lost(self, info: Mapping[str, np.ndarray]) -> np.ndarray:
        """Which games lost a life and went on."""
        lost = (info["lives"] < self._lives) & ~self._ended
        self._lives = info["lives"].copy()
        return lost

    def _check_finite(self, obs: Observation, when: str) -> None:
        if not self._is_finite(obs):
            raise self._named(not_finite(self.spec.observation_space, obs), when)

    def _named(self, fault: Fault, when: str) -> UserError:
        return named(fault, self.spec.id, "environment", self.spec.num_envs, when)

    def _observed(self, observation: Observation) -> Observation:
        if self._channels_first:
            return np.ascontiguousarray(np.moveaxis(observation, 1, -1))
        return fresh_copy(self.spec.observation_space, observation)

    def _running_pool(self) -> "GymnasiumEnvPool":
        if self._pool is None:
            raise ValueError(f"the pool of {self.spec.id} is not running: call reset(seeds) first")
        return self._pool


class PoolEnv(gymnasium.Env):
    """One environment of an EnvPool id that Gymnasium does not have, in Gymnasium's form: for evaluation and video."""

    def __init__(
        self, id: str, env_kwargs: Mapping[str, object] = NO_SETTINGS, max_episode_steps: int | None = None, render_mode: str | None = None
    ) -> None:
        """`render_mode`: None, ``rgb_array`` or ``human``, of which EnvPool knows the first two for most ids."""
        settings = dict(env_kwargs) if render_mode is None else {**env_kwargs, "render_mode": render_mode}
        self._engine = EnvPoolEngine(id, 1, env_kwargs=settings, max_episode_steps=max_episode_steps)
        self.observation_space, self.action_space = self._engine.spec.observation_space, self._engine.spec.action_space
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 30}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[object, dict]:
        """A new episode; without a seed, from this environment's own generator."""
        super().reset(seed=seed)
        return _first(self._engine.reset([int(self.np_random.integers(2**31)) if seed is None else seed])), {}

    def step(self, action: object) -> tuple[object, float, bool, bool, dict]:
        """One step; after an end call ``reset``."""
        step = self._engine.step(np.asarray(action)[None])
        return _first(step.next_obs), float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), {}

    def render(self) -> np.ndarray | None:
        """The picture ``uint8[H, W, 3]``."""
        frames = None if self.render_mode is None else self._engine.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Ends the pool."""
        self._engine.close()


class _Facts(NamedTuple):
    """What EnvPool says of an id, mended."""

    observation: gymnasium.Space
    action: gymnasium.Space
    limit: int | None
    channels_first: bool
    frames: int


def _pool_facts(id: str, env_kwargs: Mapping[str, object]) -> _Facts:
    import envpool

    settings = {name: value for name, value in env_kwargs.items() if name != "render_mode"}
    try:
        with _no_narrowing_warnings():
            spec = envpool.make_spec(id, **settings)
            observation, action = spec.gymnasium_observation_space, spec.gymnasium_action_space
    except ImportError as error:
        # Some families need more than Python packages: Procgen Qt 5.
        raise UserError(f"EnvPool cannot start {id} here: {one_line(error)}") from error
    players = getattr(spec.config, "max_num_players", 1)
    if players != 1:
        raise UserError(f"{id} has {players} players, and this engine steps one: choose an id with one player")
    channels_first = _is_channels_first(observation)
    if channels_first:
        observation = spaces.Box(0, 255, (*observation.shape[1:], observation.shape[0]), np.uint8)
    # Only of grey frames does the last axis hold nothing else.
    stacked = channels_first and getattr(spec.config, "gray_scale", False)
    frames = getattr(spec.config, "stack_num", 1) if stacked else 1
    return _Facts(_mended(observation), _mended(action), getattr(spec.config, "max_episode_steps", None), channels_first, frames)


@contextmanager
def _no_narrowing_warnings() -> Iterator[None]:
    """EnvPool makes its boxes in float64 and lets Gymnasium narrow them, with a warning that a user can do nothing about."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*precision lowered.*", UserWarning)
        yield


def _shown(own: _Facts, reference: gymnasium.Env) -> _Facts:
    """Gymnasium's spaces, where the shapes agree, and its limit."""
    same = own.observation.shape == reference.observation_space.shape
    limit = own.limit if reference.spec is None else reference.spec.max_episode_steps
    observation, action = (reference.observation_space, reference.action_space) if same else (own.observation, own.action)
    return own._replace(observation=observation, action=action, limit=limit)


def _is_channels_first(space: gymnasium.Space) -> bool:
    """An image such as ``uint8[4, 84, 84]``: few channels in front of a larger square."""
    shape = space.shape or ()
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(shape) == 3 and shape[0] <= 16 < min(shape[1:])


def _mended(space: gymnasium.Space) -> gymnasium.Space:
    """EnvPool writes the smallest positive float for minus infinity, and the largest for infinity."""
    match space:
        case spaces.Dict():
            return spaces.Dict({key: _mended(part) for key, part in space.items()})
        case spaces.Box() if space.dtype is not None and space.dtype.kind == "f":
            facts = np.finfo(space.dtype)
            low = np.where(space.low == facts.tiny, -np.inf, space.low)
            high = np.where(space.high == facts.max, np.inf, space.high)
            return spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
    return space


def _first(arrays: Observation) -> Observation:
    return take(arrays, np.array(0))
