"""Search where nobody gives the rules: through the states of a learnt model, as far as it can tell."""

from typing import NamedTuple

import jax.numpy as jnp
import mctx
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.functional.value_transform import Scale
from thorndike.games.search import Found, SearchSettings, grow
from thorndike.networks.learned_model import Model
from thorndike.networks.masking import FORBIDDEN
from thorndike.types import Number, Observation


class Imagination(NamedTuple):
    """A learnt model, and how what it says is read."""

    model: Model
    scale: Scale
    discount: Number
    """From one state to the next: negative where two take turns, for what is good for one is bad for the other."""


class Thought(NamedTuple):
    """What the model says of observations ``[B]`` without a search."""

    state: Float[Array, "B H"]
    logits: Float[Array, "B actions"]
    value: Float[Array, " B"]


def think(imagination: Imagination, params: PyTree, obs: Observation, legal: Bool[Array, "B actions"]) -> Thought:
    """States, logits of the legal actions, values."""
    state = imagination.model.represent(params, obs)
    said = imagination.model.judge(params, state)
    return Thought(state, jnp.where(legal, said.policy, FORBIDDEN), imagination.scale.number(said.value))


def imagine(
    imagination: Imagination,
    settings: SearchSettings,
    params: PyTree,
    obs: Observation,
    legal: Bool[Array, "B actions"],
    key: Key[Array, ""],
    explore: bool,
) -> Found:
    """Search from observations ``[B]``; which actions are legal is known of these alone. Consumes the key."""
    model, scale, discount = imagination
    thought = think(imagination, params, obs, legal)
    root = mctx.RootFnOutput(prior_logits=thought.logits, value=thought.value, embedding=thought.state)

    def recurrent(
        params: PyTree, key: Key[Array, ""], action: Int[Array, " B"], state: Float[Array, "B H"]
    ) -> tuple[mctx.RecurrentFnOutput, Float[Array, "B H"]]:
        del key
        after = model.follow(params, state, action)
        said = model.judge(params, after)
        reward, value = scale.number(jnp.stack([said.reward, said.value]))
        factor = jnp.broadcast_to(jnp.asarray(discount, jnp.float32), value.shape)
        return mctx.RecurrentFnOutput(reward=reward, discount=factor, prior_logits=said.policy, value=value), after

    return grow(settings, params, root, recurrent, legal, key, explore)
