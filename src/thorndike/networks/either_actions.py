"""Policies and critics for Discrete and for Box actions alike, so that a learner from data is written once."""

from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree, Shaped

from thorndike.functional.action_distributions import categorical, diagonal_gaussian
from thorndike.functional.descent import Optimized
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.temporal_difference import select
from thorndike.networks.continuous import box_dimensions, critics, policy_outputs
from thorndike.networks.heads import Shape, q_network
from thorndike.networks.hidden_layers import look_into, look_into_ensemble
from thorndike.networks.masking import masked
from thorndike.networks.network import Network, NetworkBuilder, flattened
from thorndike.networks.torso import example_observation
from thorndike.types import EnvSpec, Metrics, Observation

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0


class StochasticPolicy(NamedTuple):
    """A policy with its parameters as one vector ``[P]``. Box actions lie within [-1, 1]."""

    dimensions: int
    """D: how many normal numbers drawing an action takes."""
    init: Callable[[Key[Array, ""]], Float[Array, " P"]]
    """key -> parameters. Consumes the key."""
    log_prob: Callable[[Float[Array, " P"], Observation, Shaped[Array, "..."]], Float[Array, " M"]]
    """parameters, obs, action -> log-probability, or log density before actions are clipped."""
    sample: Callable[[Float[Array, " P"], Observation, Float[Array, "M D"]], Shaped[Array, "..."]]
    """parameters, obs, standard normal numbers -> action."""
    mode: Callable[[Float[Array, " P"], Observation], Shaped[Array, "..."]]
    probabilities: Callable[[Float[Array, " P"], Observation], Float[Array, "M A"]] | None
    """Of Discrete actions; None of a Box."""
    look: Callable[[Optimized, Observation], Metrics]
    """what is learnt, obs -> dead units, effective rank, gradient norms."""


class ActionValues(NamedTuple):
    """An ensemble of K critics, whose parameters are one array ``[K, P]``."""

    init: Callable[[Key[Array, ""]], Float[Array, "K P"]]
    """key -> parameters. Consumes the key."""
    taken: Callable[[Float[Array, "K P"], Observation, Shaped[Array, "..."]], Float[Array, "K M"]]
    """parameters, obs, action -> its value according to each critic."""
    every: Callable[[Float[Array, "K P"], Observation], Float[Array, "K M A"]] | None
    """parameters, obs -> values of all Discrete actions, those forbidden very low; None of a Box."""
    look: Callable[[Optimized, Observation, Shaped[Array, "..."]], Metrics]
    """what is learnt, obs, action -> dead units, effective rank, gradient norms: the mean over the critics."""


def number_of_actions(spec: EnvSpec) -> int | None:
    """How many Discrete actions there are; None where actions are of another kind."""
    return int(spec.action_space.n) if isinstance(spec.action_space, gymnasium.spaces.Discrete) else None


def stochastic_policy(name: str, spec: EnvSpec, shape: Shape, given: NetworkBuilder | None = None) -> StochasticPolicy:
    """Softmax over Discrete actions; of a Box a Gaussian whose mean is squashed into the bounds and whose draws are clipped to them.

    Raises ``UserError`` for other action spaces.
    """
    count = number_of_actions(spec)
    if count is None:
        return _gaussian(name, spec, shape, given)
    network, init = policy_outputs(spec, count, shape.net_arch, shape.activation, given)
    logits, family = masked(network, spec).apply, categorical(count)

    def sample(params: Float[Array, " P"], obs: Observation, noise: Float[Array, "M D"]) -> Shaped[Array, "..."]:
        # The distribution function of the normal makes the noise uniform, and so Gumbel.
        return family.sample(logits(params, obs), -jnp.log(-jax.scipy.special.log_ndtr(noise)))

    return StochasticPolicy(
        dimensions=count,
        init=init,
        log_prob=lambda params, obs, action: family.log_prob(logits(params, obs), action),
        sample=sample,
        mode=lambda params, obs: family.mode(logits(params, obs)),
        probabilities=lambda params, obs: jax.nn.softmax(logits(params, obs)),
        look=_look_into_policy(network),
    )


def action_values(name: str, spec: EnvSpec, number: int, shape: Shape) -> ActionValues:
    """``number`` critics. Raises ``UserError`` for actions that are neither Discrete nor a Box of one row."""
    count = number_of_actions(spec)
    if count is None:
        ensemble = critics(spec, box_dimensions(name, spec), number, shape.net_arch, shape.activation, layer_norm=shape.layer_norm)
        return ActionValues(ensemble.init, lambda params, obs, action: ensemble.apply(params, obs, action)[..., 0], None, ensemble.look)
    plain, example = q_network(spec, count, shape, dueling=False), example_observation(spec.observation_space)
    flat = flattened(plain, example)

    def init(key: Key[Array, ""]) -> Float[Array, "K P"]:
        return jax.vmap(lambda one: ravel_pytree(plain.init(one, example))[0])(jax.random.split(key, number))

    def every(params: Float[Array, "K P"], obs: Observation) -> Float[Array, "K M A"]:
        return jax.vmap(lambda one: flat.apply(one, obs))(params)

    def taken(params: Float[Array, "K P"], obs: Observation, action: Shaped[Array, "..."]) -> Float[Array, "K M"]:
        values = every(params, obs)
        return select(values, jnp.broadcast_to(action, values.shape[:2]))

    def look(learnt: Optimized, obs: Observation, action: Shaped[Array, "..."]) -> Metrics:
        del action

        def layers(one: Float[Array, " P"]) -> PyTree:
            return {} if flat.layers is None else flat.layers(one, obs)

        return look_into_ensemble("critics", layers, flat.modules, learnt.params, mean_square_gradient(learnt.opt_state))

    return ActionValues(init, taken, every, look)


def _look_into_policy(network: Network) -> Callable[[Optimized, Observation], Metrics]:
    return lambda learnt, obs: look_into(network, learnt.params, obs, mean_square_gradient(learnt.opt_state), "actor")


def _gaussian(name: str, spec: EnvSpec, shape: Shape, given: NetworkBuilder | None) -> StochasticPolicy:
    dimensions = box_dimensions(name, spec)
    network, init = policy_outputs(spec, 2 * dimensions, shape.net_arch, shape.activation, given)
    family = diagonal_gaussian(dimensions)

    def parameters(params: Float[Array, " P"], obs: Observation) -> Float[Array, "M D2"]:
        mean, log_std = jnp.split(network.apply(params, obs), 2, axis=-1)
        return jnp.concatenate([jnp.tanh(mean), jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)], axis=-1)

    return StochasticPolicy(
        dimensions=dimensions,
        init=init,
        log_prob=lambda params, obs, action: family.log_prob(parameters(params, obs), action),
        sample=lambda params, obs, noise: jnp.clip(family.sample(parameters(params, obs), noise), -1.0, 1.0),
        mode=lambda params, obs: family.mode(parameters(params, obs)),
        probabilities=None,
        look=_look_into_policy(network),
    )
