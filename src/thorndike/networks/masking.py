"""Action masks: which actions are allowed now. They come in with the observation, as the entry ``action_mask`` of a Dict space.

A mask is 1 where an action is allowed, with one entry an action (Discrete), or the entries of all components one after another
(MultiDiscrete; MultiBinary counts as components of two). Huang and Ontanon 2020 (arXiv:2006.14171) show that setting the logits of
forbidden actions to a very low number is a valid policy gradient. A mask that allows nothing, as some environments give after the last
step, counts as one that allows everything.
"""

import gymnasium
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, PyTree

from thorndike.errors import UserError
from thorndike.networks.network import Network, with_outputs
from thorndike.types import EnvSpec, Observation

MASK = "action_mask"
BOARD, POSITION = "board", "position"
"""The other entries of a game's observation: what a player sees, and all there is, from which to search."""
FORBIDDEN = -1e9
"""In place of minus infinity, whose gradients are no numbers."""


def has_mask(space: gymnasium.Space) -> bool:
    """Whether observations of this space bring a mask."""
    return isinstance(space, spaces.Dict) and MASK in space.spaces


def without_mask(space: gymnasium.Space) -> gymnasium.Space:
    """The space of what is really observed; where that is a single entry, that entry's own space."""
    if not isinstance(space, spaces.Dict) or MASK not in space.spaces:
        return space
    rest = {name: part for name, part in space.spaces.items() if name != MASK}
    return next(iter(rest.values())) if len(rest) == 1 else spaces.Dict(rest)


def without_position(space: gymnasium.Space) -> gymnasium.Space:
    """The space less the whole position, where it is a game's: for a search, and not for a network."""
    if not isinstance(space, spaces.Dict) or space.spaces.keys() != {BOARD, MASK, POSITION}:
        return space
    return spaces.Dict({name: part for name, part in space.spaces.items() if name != POSITION})


def observed(space: gymnasium.Space, obs: Observation) -> Observation:
    """The part of ``obs`` that ``without_mask(space)`` describes."""
    if not isinstance(space, spaces.Dict) or MASK not in space.spaces:
        return obs
    rest = {name: obs[name] for name in space.spaces if name != MASK}
    return next(iter(rest.values())) if len(rest) == 1 else rest


def allowed(obs: Observation) -> Bool[Array, "*B n"]:
    """The mask of an observation that has one."""
    mask = obs[MASK].astype(bool)
    return mask | ~jnp.any(mask, axis=-1, keepdims=True)


def masked(network: Network, spec: EnvSpec) -> Network:
    """The same network with the outputs of forbidden actions at ``FORBIDDEN``: Q-values, or the logits of a policy and its value.

    Unchanged where the environment has no masks. Raises ``UserError`` if the mask does not fit the actions.
    """
    if not has_mask(spec.observation_space):
        return network
    sizes = check_mask(spec)

    def mask(outputs: PyTree, obs: Observation) -> PyTree:
        if isinstance(outputs, tuple):
            return hide(outputs[0], obs), *outputs[1:]
        return hide(outputs, obs)

    def hide(values: Float[Array, "*B n"], obs: Observation) -> Float[Array, "*B n"]:
        parts = jnp.split(obs[MASK].astype(bool), np.cumsum(sizes)[:-1], axis=-1)
        open_ = jnp.concatenate([part | ~jnp.any(part, axis=-1, keepdims=True) for part in parts], axis=-1)
        return jnp.where(open_, values, FORBIDDEN)

    return with_outputs(network, mask)


def hide_forbidden(q: Float[Array, "*B A"], space: gymnasium.Space, obs: Observation) -> Float[Array, "*B A"]:
    """Q-values with those of forbidden actions at ``FORBIDDEN``; as they are where observations bring no mask."""
    return jnp.where(allowed(obs), q, FORBIDDEN) if has_mask(space) else q


def check_mask(spec: EnvSpec) -> list[int]:
    """How many entries of the mask belong to each component of an action. Raises ``UserError`` if it does not fit the actions."""
    actions, came = spec.action_space, _mask_space(spec.observation_space).shape
    if isinstance(actions, spaces.Discrete):
        sizes = [int(actions.n)]
    elif isinstance(actions, spaces.MultiDiscrete) and actions.nvec.ndim == 1:
        sizes = [int(n) for n in actions.nvec]
    elif isinstance(actions, spaces.MultiBinary) and len(actions.shape) == 1:
        sizes = [2] * actions.shape[0]
    else:
        raise UserError(f"action masks are for Discrete, MultiDiscrete and MultiBinary actions; {spec.id} has a mask and {actions}")
    if came != (sum(sizes),):
        raise UserError(f"the action_mask of {spec.id} has shape {came}, but {actions} needs ({sum(sizes)},): one entry an action")
    return sizes


def _mask_space(space: gymnasium.Space) -> gymnasium.Space:
    if isinstance(space, spaces.Dict):
        return space.spaces[MASK]
    raise UserError(f"{space} brings no {MASK}: give a Dict space with that entry")
