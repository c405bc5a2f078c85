"""An ensemble of Q-networks, each the sum of what it learns and of a prior of its own that it never unlearns."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Optimized
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.networks.heads import Shape, q_outputs
from thorndike.networks.hidden_layers import look_into_ensemble
from thorndike.networks.masking import check_mask, has_mask, hide_forbidden
from thorndike.networks.network import NetworkBuilder, flattened
from thorndike.networks.torso import example_observation
from thorndike.types import EnvSpec, Metrics, Number, Observation


class Ensemble(NamedTuple):
    """``K`` networks of the same shape, whose parameters are one array ``[K, P]``."""

    init: Callable[[Key[Array, ""]], Float[Array, "K P"]]
    """key -> parameters, of the networks or of their priors. Consumes the key."""
    values: Callable[[Float[Array, "K P"], Float[Array, "K P"], Observation], Float[Array, "K B A"]]
    """parameters, priors, obs ``[B, ...]`` -> Q-values of every member, those of forbidden actions very low."""
    look: Callable[[Optimized, Observation], Metrics]
    """what is learnt ``[K, P]``, obs -> dead units, effective rank, gradient norms, without the priors: the mean over the members."""


def value_ensemble(
    spec: EnvSpec, actions: int, shape: Shape, members: int, prior_scale: Number, given: NetworkBuilder | None = None
) -> Ensemble:
    """``Q_k = f_k + prior_scale * p_k`` with ``p_k`` fixed: Osband, Aslanides and Cassirer 2018 (arXiv:1806.03335), algorithm 1.

    The user's own network if one is ``given``. Raises ``UserError`` for one with memory, or masks that do not fit the actions.
    """
    if has_mask(spec.observation_space):
        check_mask(spec)
    plain, example = q_outputs(spec, actions, shape, False, 1, given), example_observation(spec.observation_space)
    if plain.recurrence is not None:
        raise UserError("an ensemble has no memory: give a network without recurrence, or use dqn with memory")
    network = flattened(plain, example)

    def init(key: Key[Array, ""]) -> Float[Array, "K P"]:
        return jax.vmap(lambda one: ravel_pytree(plain.init(one, example))[0])(jax.random.split(key, members))

    def values(params: Float[Array, "K P"], priors: Float[Array, "K P"], obs: Observation) -> Float[Array, "K B A"]:
        def member(own: Float[Array, " P"], prior: Float[Array, " P"]) -> Float[Array, "B A"]:
            q = jnp.asarray(network.apply(own, obs)) + prior_scale * jnp.asarray(network.apply(prior, obs))
            return hide_forbidden(q, spec.observation_space, obs)

        return jax.vmap(member)(params, priors)

    def look(learnt: Optimized, obs: Observation) -> Metrics:
        def layers(flat: Float[Array, " P"]) -> PyTree:
            return {} if network.layers is None else network.layers(flat, obs)

        return look_into_ensemble("members", layers, network.modules, learnt.params, mean_square_gradient(learnt.opt_state))

    return Ensemble(init, values, look)
