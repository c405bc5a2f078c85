"""A native environment in Gymnasium's form: for evaluating on one that Gymnasium does not have, such as a probe."""

import gymnasium
import jax
import numpy as np

from thorndike.types import Environment


class NativeEnv(gymnasium.Env):
    """The first environment of a native batch, stepped one action at a time. It draws nothing: ``render`` is not supported."""

    def __init__(self, environment: Environment) -> None:
        """Compiles `environment`; where its batch has more than one, all do the same and the first is shown."""
        self.observation_space, self.action_space = environment.spec.observation_space, environment.spec.action_space
        self._num_envs = environment.spec.num_envs
        self._init = jax.jit(environment.init)
        self._draw = jax.jit(environment.draw, static_argnums=1)
        self._step = jax.jit(environment.step)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[object, dict]:
        """A new episode; without a seed, from this environment's own generator."""
        super().reset(seed=seed)
        self._state, obs = self._init(self._key())
        return self._first(obs), {}

    def step(self, action: object) -> tuple[object, float, bool, bool, dict]:
        """One step; after an end call ``reset``."""
        noise = jax.tree.map(lambda leaf: leaf[0], self._draw(self._key(), 1))
        actions = np.repeat(np.asarray(action)[None], self._num_envs, axis=0)
        actions = actions.astype(np.float32 if actions.dtype.kind == "f" else np.int32)
        self._state, step = self._step(self._state, actions, noise)
        return self._first(step.next_obs), float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), {}

    def _key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def _first(self, obs: object) -> object:
        return jax.tree.map(lambda leaf: np.asarray(leaf[0]), obs)
