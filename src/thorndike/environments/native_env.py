"""A native environment in Gymnasium's form: for evaluating on one that Gymnasium does not have, such as a probe."""

import gymnasium
import jax
import numpy as np
from jaxtyping import Array, PyTree, UInt32

from thorndike.types import Environment


class NativeEnv(gymnasium.Env):
    """The first environment of a native batch, stepped one action at a time. It draws nothing: ``render`` is not supported."""

    def __init__(self, environment: Environment) -> None:
        """Compiles `environment`; where its batch has more than one, all do the same and the first is shown."""
        self.observation_space, self.action_space = environment.spec.observation_space, environment.spec.action_space
        self._num_envs = environment.spec.num_envs
        self.native_limit = environment.spec.max_episode_steps
        """The time limit that its steps have already: it has no Gymnasium spec that would say so."""

        def first(tree: PyTree) -> PyTree:
            return jax.tree.map(lambda leaf: leaf[0], tree)

        def start(seed: UInt32[Array, ""]) -> tuple[PyTree, PyTree]:
            state, obs = environment.init(jax.random.key(seed))
            return state, first(obs)

        def move(state: PyTree, actions: Array, seed: UInt32[Array, ""]) -> tuple[PyTree, PyTree]:
            state, step = environment.step(state, actions, first(environment.draw(jax.random.key(seed), 1)))
            return state, first((step.next_obs, step.reward, step.terminated, step.truncated))

        # One program a call, not many small ones with Python between them.
        self._start, self._move = jax.jit(start), jax.jit(move)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[object, dict]:
        """A new episode; without a seed, from this environment's own generator."""
        super().reset(seed=seed)
        self._state, obs = self._start(self._seed())
        return jax.tree.map(np.asarray, obs), {}

    def step(self, action: object) -> tuple[object, float, bool, bool, dict]:
        """One step; after an end call ``reset``."""
        actions = np.repeat(np.asarray(action)[None], self._num_envs, axis=0)
        actions = actions.astype(np.float32 if actions.dtype.kind == "f" else np.int32)
        self._state, outcome = self._move(self._state, actions, self._seed())
        obs, reward, terminated, truncated = jax.tree.map(np.asarray, outcome)
        return obs, float(reward), bool(terminated), bool(truncated), {}

    def _seed(self) -> np.uint32:
        return np.uint32(self.np_random.integers(2**31))
