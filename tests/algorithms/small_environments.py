"""Two tiny compiled environments: one that cannot be solved without memory, one whose actions are not always allowed."""

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from thorndike.environments.native.randomness import draw_words, no_noise
from thorndike.environments.native.vectorize import Dynamics

RECALL_STEPS = 4
ACTIONS = 5


def recall() -> Dynamics:
    """A cue, +1 or -1, is seen in the first observation only; the last of four actions earns 1 if it names it, else -1."""

    def reset(words):
        cue = ((words >> 7) & 1).astype(jnp.int32)
        return jnp.stack([cue, jnp.zeros_like(cue)], axis=-1)

    def observe(state):
        cue, t = state[..., 0], state[..., 1]
        return jnp.stack([jnp.where(t == 0, 2 * cue - 1, 0), t == RECALL_STEPS - 1], axis=-1).astype(jnp.float32)

    def step(state, action, noise):
        cue, t = state[..., 0], state[..., 1]
        last = t == RECALL_STEPS - 1
        reward = jnp.where(last, jnp.where(action == cue, 1.0, -1.0), 0.0)
        return jnp.stack([cue, t + 1], axis=-1), reward, last

    return Dynamics(reset, observe, step, draw_words, no_noise, spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(2), "recall")


def forbidding(components: int = 1) -> Dynamics:
    """Each step allows a random set of actions, of every component; a forbidden one ends it with -1,000, the highest one earns 1.

    Ends after 8 steps. ``components`` above 1 make the actions MultiDiscrete.
    """
    full = 2**ACTIONS - 1

    def along(numbers, like):
        return numbers.reshape((1,) * like.ndim + numbers.shape)

    def bits(state):
        return (state[..., None] >> along(jnp.arange(ACTIONS * components), state)) & 1

    def mask(words):
        parts = [(words >> jnp.uint32(5 * i)) & jnp.uint32(full) for i in range(components)]
        kept = [jnp.where(part == 0, jnp.uint32(full), part) << jnp.uint32(ACTIONS * i) for i, part in enumerate(parts)]
        return sum(kept[1:], kept[0]).astype(jnp.int32)

    def observe(state):
        return {"observation": bits(state[..., 0]).astype(jnp.float32), "action_mask": bits(state[..., 0]).astype(jnp.int32)}

    def step(state, action, noise):
        allowed = bits(state[..., 0]).reshape((*state.shape[:-1], components, ACTIONS))
        chosen = action.reshape((*state.shape[:-1], components))
        legal = jnp.take_along_axis(allowed, chosen[..., None], axis=-1)[..., 0].all(axis=-1)
        best = (jnp.max(allowed * along(jnp.arange(1, ACTIONS + 1), chosen), axis=-1) - 1 == chosen).all(axis=-1)
        reward = jnp.where(legal, best.astype(jnp.float32), -1000.0)
        after = jnp.stack([mask(noise), state[..., 1] + 1], axis=-1)
        return after, reward, ~legal | (state[..., 1] >= 7)

    space = spaces.Dict({"observation": spaces.Box(0, 1, (ACTIONS * components,)), "action_mask": spaces.MultiBinary(ACTIONS * components)})
    actions = spaces.Discrete(ACTIONS) if components == 1 else spaces.MultiDiscrete([ACTIONS] * components)

    def reset(words):
        first = mask(words)
        return jnp.stack([first, jnp.zeros_like(first)], axis=-1)

    return Dynamics(reset, observe, step, draw_words, draw_words, space, actions, "forbidding")
