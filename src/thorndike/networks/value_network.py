"""The network of the deep Q-learners: what it says of every action's return, of any form, with noisy layers or without."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.distributional import ReturnDistribution, midpoints
from thorndike.functional.value_loss import Said
from thorndike.networks.heads import Shape, q_outputs
from thorndike.networks.implicit import implicit_network
from thorndike.networks.masking import check_mask, has_mask, hide_forbidden
from thorndike.networks.network import Network, NetworkBuilder, apply_rollout, as_rows, with_outputs
from thorndike.networks.noisy import noise_of
from thorndike.networks.torso import example_observation
from thorndike.types import EnvSpec, Number, Observation, Rollout

LEVELS_TO_ACT_BY = 32
"""K of Dabney et al. 2018 (IQN): the quantile levels whose mean an implicit network acts by; midpoints here, drawn in the paper."""


class Form(NamedTuple):
    """What a value network is made of besides its shape."""

    dueling: bool
    noisy_sigma: Number | None
    """The noise of noisy layers at the start; None without them."""
    implicit: bool
    """Whether it takes quantile levels as an input."""


class ValueNetwork(NamedTuple):
    """Parameters are one flat vector: optimiser, target and gradient are then a few kernels, not a few a layer.

    ``weights``, a tree, is what the network computes with: the parameters themselves, or with noisy layers their means or a draw of them.
    """

    init: Callable[[Key[Array, ""]], Float[Array, " P"]]
    """key -> parameters. Consumes the key."""
    means: Callable[[Float[Array, " P"]], PyTree]
    """parameters -> the weights to be judged by."""
    drawn: Callable[[Float[Array, " P"], Float[Array, " N"]], PyTree]
    """parameters, standard normal numbers -> the weights to explore and to learn with."""
    noise_size: int
    """N: 0 without noisy layers."""
    network: Network
    """weights, obs -> outputs ``[*B, A, K]``, whatever the masks."""
    at: Callable[[PyTree, Observation, Float[Array, "M K"]], Float[Array, "M A K"]]
    """weights, obs, quantile levels -> outputs; only an implicit network looks at the levels."""
    q: Callable[[Float[Array, "*B A K"], Observation], Float[Array, "*B A"]]
    """outputs, the obs they are for -> Q-values, those of forbidden actions very low."""


class Levels(NamedTuple):
    """The quantile levels of a minibatch's outputs, ``[M, K]``: those learnt at, and those of the target."""

    learnt: Float[Array, "M K"]
    target: Float[Array, "M K"]


def read_transitions(net: ValueNetwork, weights: PyTree, target: PyTree, obs: Observation, next_obs: Observation, levels: Levels) -> Said:
    """What both networks say of single transitions. What a loss does not use, the compiler never computes."""
    outputs, online_next = net.at(weights, obs, levels.learnt), net.at(weights, next_obs, levels.target)
    target_now, target_next = net.at(target, obs, levels.target), net.at(target, next_obs, levels.target)
    q_next, target_q, target_q_next = net.q(online_next, next_obs), net.q(target_now, obs), net.q(target_next, next_obs)
    return Said(outputs, levels.learnt, q_next, target_q, target_next, target_q_next)


def read_sequences(net: ValueNetwork, weights: PyTree, target: PyTree, sequences: Rollout, levels: Levels) -> Said:
    """The same of sequences, as rows ``[T * M]``; both networks unroll their memories from the stored one.

    Hausknecht and Stone 2015 (arXiv:1507.06527); Kapturowski et al. 2019 (R2D2), "stored state".
    """
    obs, next_obs = sequences.obs, sequences.step.next_obs
    outputs, online_next = apply_rollout(net.network, weights, sequences)
    target_now, target_next = apply_rollout(net.network, target, sequences)
    q_next, target_q, target_q_next = net.q(online_next, next_obs), net.q(target_now, obs), net.q(target_next, next_obs)
    rows = as_rows((outputs, q_next, target_q, target_next, target_q_next))
    return Said(rows[0], levels.learnt, *rows[1:])


def value_network(
    spec: EnvSpec, actions: int, shape: Shape, form: Form, distribution: ReturnDistribution, given: NetworkBuilder | None = None
) -> ValueNetwork:
    """Build it; the user's own if one is ``given``, which has ``actions * K`` outputs, one action after another.

    Raises ``UserError`` for parts that do not go together.
    """
    if has_mask(spec.observation_space):
        check_mask(spec)
    example = example_observation(spec.observation_space)
    judge = partial(_judge, distribution, spec)
    if form.implicit:
        return _implicit(spec, actions, shape, form, distribution.outputs, judge, given)
    plain = q_outputs(spec, actions, shape, form.dueling, distribution.outputs, given)
    shaped = with_outputs(plain, lambda out, obs: out.reshape((*out.shape[:-1], actions, distribution.outputs)))
    return _with_noise(plain, shaped, example, form, lambda weights, obs, fractions: shaped.apply(weights, obs), judge)


def _judge(distribution: ReturnDistribution, spec: EnvSpec, outputs: Float[Array, "*B A K"], obs: Observation) -> Float[Array, "*B A"]:
    return hide_forbidden(distribution.mean(outputs), spec.observation_space, obs)


def _implicit(
    spec: EnvSpec, actions: int, shape: Shape, form: Form, outputs: int, judge: Callable[..., Array], given: NetworkBuilder | None
) -> ValueNetwork:
    if given is not None or shape.memory != "none":
        raise UserError("implicit quantiles come with their own network, without memory: leave the network and memory as they are")
    plain = implicit_network(spec.observation_space, actions, shape.net_arch, shape.activation, form.dueling, shape.cnn)
    example = (example_observation(spec.observation_space), jnp.zeros((1, outputs)))

    def with_levels(obs: Observation) -> tuple[Observation, Array]:
        rows = jax.tree.leaves(obs)[0].shape[0]
        return obs, jnp.broadcast_to(midpoints(LEVELS_TO_ACT_BY)[None], (rows, LEVELS_TO_ACT_BY))

    look = plain.layers
    acting = Network(
        plain.init,
        lambda weights, obs: plain.apply(weights, with_levels(obs)),
        layers=None if look is None else lambda weights, obs: look(weights, with_levels(obs)),
    )
    return _with_noise(plain, acting, example, form, lambda weights, obs, fractions: plain.apply(weights, (obs, fractions)), judge)


def _with_noise(
    plain: Network, shaped: Network, example: PyTree, form: Form, at: Callable[..., Array], judge: Callable[..., Array]
) -> ValueNetwork:
    def init(key: Key[Array, ""]) -> Float[Array, " P"]:
        return ravel_pytree(plain.init(key, example))[0]

    template = jax.eval_shape(plain.init, jax.random.key(0), example)
    count, unravel = _vector_of(template)
    if form.noisy_sigma is None:
        return ValueNetwork(init, unravel, lambda params, noise: unravel(params), 0, shaped, at, judge)
    noise = noise_of(template, form.noisy_sigma)

    def drawn(params: Float[Array, " P"], numbers: Float[Array, " N"]) -> PyTree:
        means, spreads = unravel(params[:count]), unravel(params[count:])
        return jax.tree.map(lambda mean, spread, z: mean + spread * z, means, spreads, noise.shaped(numbers))

    return ValueNetwork(
        init=lambda key: jnp.concatenate([init(key), ravel_pytree(noise.spread)[0]]),
        means=lambda params: unravel(params[:count]),
        drawn=drawn,
        noise_size=noise.size,
        network=shaped,
        at=at,
        q=judge,
    )


def _vector_of(template: PyTree) -> tuple[int, Callable[[Float[Array, " W"]], PyTree]]:
    """How many weights a tree of these shapes has, and the way from a vector of them to the tree."""
    vector, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), template))
    return vector.shape[0], unravel
