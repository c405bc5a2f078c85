"""Search where nobody gives the rules: through the states of a learnt model, as far as it can tell."""

from typing import NamedTuple

import jax.numpy as jnp
import mctx
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.value_transform import Scale
from thorndike.games.board_view import View
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
    view: View
    """What the model is shown of observations, and which actions are legal there."""


class Thought(NamedTuple):
    """What the model says of observations ``[B]`` without a search."""

    state: Float[Array, "B H"]
    logits: Float[Array, "B actions"]
    value: Float[Array, " B"]


def think(imagination: Imagination, params: PyTree, seen: Observation) -> Thought:
    """States, logits of the legal actions, values of what is seen ``[B, ...]``."""
    state = imagination.model.represent(params, seen)
    said = imagination.model.judge(params, state)
    logits = jnp.where(imagination.view.legal(seen), said.policy, FORBIDDEN)
    return Thought(state, logits, imagination.scale.number(said.value))


def imagine(
    imagination: Imagination, settings: SearchSettings, params: PyTree, seen: Observation, key: Key[Array, ""], explore: bool
) -> Found:
    """Search from what is seen ``[B, ...]``; which actions are legal is known there alone. Consumes the key."""
    model, scale, discount, view = imagination
    thought = think(imagination, params, seen)
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

    return grow(settings, params, root, recurrent, view.legal(seen), key, explore)
