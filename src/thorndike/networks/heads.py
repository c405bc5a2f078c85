"""Complete networks: a policy with its value, and Q-values."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from thorndike.errors import UserError
from thorndike.functional.action_distributions import ActionDistribution, action_distribution
from thorndike.functional.held_noise import noise_features, state_dependent_parameters, with_constant
from thorndike.networks.dense import dense
from thorndike.networks.hidden_layers import hidden_layers
from thorndike.networks.masking import masked
from thorndike.networks.network import Network, NetworkBuilder, apply_step
from thorndike.networks.recurrent import Remembering, remembering, side_by_side
from thorndike.networks.torso import MLP, Torso, is_image, torch_uniform
from thorndike.types import EnvSpec, Number, Observation


class ActorCritic(nn.Module):
    """Policy parameters ``[B, P]`` and a value ``[B]``, from two separate torsos, or one shared torso on images."""

    space: gymnasium.Space
    outputs: int
    free_parameters: int
    hidden: Sequence[int]
    activation: str
    log_std_init: Number
    state_dependent: bool = False
    cnn: str = "nature"

    @nn.compact
    def __call__(self, obs: Observation) -> tuple[Float[Array, "B P"], Float[Array, " B"]]:
        """Observation ``[B, ...]`` to policy parameters and value."""
        hidden_init = nn.initializers.orthogonal(2.0**0.5)
        policy_torso = Torso(self.space, self.hidden, self.activation, hidden_init, cnn=self.cnn, name="policy_torso")
        features = policy_torso(obs)
        if is_image(self.space):
            value_features = features
        else:
            value_features = Torso(self.space, self.hidden, self.activation, hidden_init, name="value_torso")(obs)
        parameters = policy_parameters(self, features)
        value = dense(1, nn.initializers.orthogonal(1.0), name="value")(value_features)
        return parameters, value[..., 0]


class PolicyHead(nn.Module):
    """Policy parameters ``[B, P]`` from features."""

    outputs: int
    free_parameters: int
    log_std_init: Number
    state_dependent: bool = False

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> Float[Array, "B P"]:
        """Features to policy parameters."""
        return policy_parameters(self, features)


def policy_parameters(module: ActorCritic | PolicyHead, features: Float[Array, "B F"]) -> Float[Array, "B P"]:
    """The policy's parameters from its features, within a module that says how: those of the network, then the free ones.

    With ``state_dependent`` exploration, what ``state_dependent_parameters`` makes of them; features are learnt for the mean alone.
    """
    parameters = dense(module.outputs, nn.initializers.orthogonal(0.01), name="policy")(features)
    start = nn.initializers.constant(module.log_std_init)
    if module.state_dependent:
        log_std = module.param("log_std", start, (noise_features(features.shape[-1]), module.outputs))
        return state_dependent_parameters(parameters, with_constant(jax.lax.stop_gradient(features)), log_std)
    if not module.free_parameters:
        return parameters
    log_std = module.param("log_std", start, (module.free_parameters,))
    return jnp.concatenate([parameters, jnp.broadcast_to(log_std, (*parameters.shape[:-1], module.free_parameters))], axis=-1)


class ValueHead(nn.Module):
    """A value ``[B]`` from features."""

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> Float[Array, " B"]:
        """Features to a value."""
        return dense(1, nn.initializers.orthogonal(1.0), name="value")(features)[..., 0]


class PolicyAndValue(nn.Module):
    """Both from the same features: the head of a network that sees images and has a memory."""

    outputs: int
    free_parameters: int
    log_std_init: Number
    state_dependent: bool = False

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> tuple[Float[Array, "B P"], Float[Array, " B"]]:
        """Features to policy parameters and value."""
        return PolicyHead(self.outputs, self.free_parameters, self.log_std_init, self.state_dependent)(features), ValueHead()(features)


class QHead(nn.Module):
    """Q-values ``[B, A]`` from features; ``dueling`` and ``outputs`` as in ``QValues``."""

    actions: int
    dueling: bool
    outputs: int = 1

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> Float[Array, "B A"]:
        """Features to one value an action."""
        advantage = dense(self.actions * self.outputs, torch_uniform, name="q")(features)
        if not self.dueling:
            return advantage
        return combined(dense(self.outputs, torch_uniform, name="value")(features), advantage)


class QValues(nn.Module):
    """Q-values ``[B, A]``; ``dueling`` splits them into value and advantages (Wang et al. 2016, arXiv:1511.06581, eq. 9).

    Where ``outputs`` numbers describe an action, they stand one action after another: ``[B, A * outputs]``.
    """

    space: gymnasium.Space
    actions: int
    hidden: Sequence[int]
    activation: str
    dueling: bool
    outputs: int = 1
    layer_norm: bool = False
    cnn: str = "nature"

    @nn.compact
    def __call__(self, obs: Observation) -> Float[Array, "B A"]:
        """Observation ``[B, ...]`` to one value an action."""
        shared = self.hidden[:-1] if self.dueling else self.hidden
        features = Torso(self.space, shared, self.activation, torch_uniform, self.layer_norm, self.cnn, name="torso")(obs)
        if not self.dueling:
            return dense(self.actions * self.outputs, torch_uniform, name="q")(features)
        return combined(self._stream(features, 1, "value"), self._stream(features, self.actions, "advantage"))

    def _stream(self, features: Float[Array, "B F"], rows: int, name: str) -> Float[Array, "B G"]:
        outputs = rows * self.outputs
        return MLP(self.hidden[-1:], self.activation, torch_uniform, outputs=outputs, layer_norm=self.layer_norm, name=name)(features)


def combined(value: Float[Array, "*B K"], advantage: Float[Array, "*B AK"]) -> Float[Array, "*B AK"]:
    """Value plus advantages less their mean, for each of the ``K`` numbers that describe an action."""
    outputs = value.shape[-1]
    if outputs == 1:
        return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)
    rows = advantage.reshape((*advantage.shape[:-1], -1, outputs))
    return (value[..., None, :] + rows - jnp.mean(rows, axis=-2, keepdims=True)).reshape(advantage.shape)


def actor_critic(
    space: gymnasium.Space,
    outputs: int,
    free_parameters: int,
    hidden: Sequence[int],
    activation: str,
    log_std_init: Number = 0.0,
    state_dependent: bool = False,
    cnn: str = "nature",
) -> Network:
    """A policy and its value. ``outputs`` is what the network computes of ``P``: see ``policy_parameters``."""
    return _pair(ActorCritic(space, outputs, free_parameters, tuple(hidden), activation, log_std_init, state_dependent, cnn))


def q_values(
    space: gymnasium.Space,
    actions: int,
    hidden: Sequence[int],
    activation: str,
    dueling: bool = False,
    outputs: int = 1,
    layer_norm: bool = False,
    cnn: str = "nature",
) -> Network:
    """Q-values of every action, or ``outputs`` numbers of each."""
    return _pair(QValues(space, actions, tuple(hidden), activation, dueling, outputs, layer_norm, cnn))


class Shape(NamedTuple):
    """The size of a network, in the words of the settings."""

    net_arch: tuple[int, ...]
    activation: str
    memory: str = "none"
    """``none``, ``gru`` or ``lstm``."""
    memory_size: int = 64
    layer_norm: bool = False
    """Normalise each hidden layer before its activation; for Q-values without memory."""
    cnn: str = "nature"
    """The convolutions of images: see ``cnn.py``."""


def policy_network(
    spec: EnvSpec, distribution: ActionDistribution, shape: Shape, log_std_init: Number, given: NetworkBuilder | None = None
) -> Network:
    """A policy and its value for an environment, masks honoured; the user's own if one is ``given``.

    Raises ``UserError`` for one of the user's own with state-dependent exploration, which needs its last features.
    """
    if given is not None:
        if distribution.features:
            raise UserError("use_sde explores by the features of the library's own network: set use_sde to false, or give no network")
        return masked(given(spec, distribution.network_outputs + distribution.free_parameters), spec)
    hidden_init = nn.initializers.orthogonal(2.0**0.5)
    outputs, free, smooth = distribution.network_outputs, distribution.free_parameters, distribution.features > 0
    if shape.memory == "none":
        form = (outputs, free, shape.net_arch, shape.activation, log_std_init, smooth, shape.cnn)
        return masked(actor_critic(spec.observation_space, *form), spec)
    if is_image(spec.observation_space):
        return masked(_remembering(spec, shape, hidden_init, PolicyAndValue(outputs, free, log_std_init, smooth)), spec)
    # One memory for both would be shaped by the value's gradient, which is far larger: the policy then learns nothing (measured).
    policy = _remembering(spec, shape, hidden_init, PolicyHead(outputs, free, log_std_init, smooth))
    return masked(side_by_side(policy, _remembering(spec, shape, hidden_init, ValueHead())), spec)


def stochastic_policy(
    spec: EnvSpec, shape: Shape, kind: str, use_sde: bool, log_std_init: Number, given: NetworkBuilder | None = None
) -> tuple[ActionDistribution, Network]:
    """How actions are distributed, by the settings ``action_distribution`` and ``use_sde``, and the network that says so, with its value.

    Raises ``UserError`` where these, the action space and the network do not go together.
    """
    if use_sde and shape.memory == "none" and not shape.net_arch:
        raise UserError("use_sde explores by the features of the last hidden layer: net_arch needs one")
    width = shape.net_arch[-1] if shape.memory == "none" and shape.net_arch else shape.memory_size
    distribution = action_distribution(spec.action_space, kind, noise_features(width) if use_sde else 0)
    return distribution, policy_network(spec, distribution, shape, log_std_init, given)


def q_network(spec: EnvSpec, actions: int, shape: Shape, dueling: bool, given: NetworkBuilder | None = None) -> Network:
    """Q-values of every action, masks honoured; the user's own network if one is ``given``."""
    return masked(q_outputs(spec, actions, shape, dueling, 1, given), spec)


def q_outputs(spec: EnvSpec, actions: int, shape: Shape, dueling: bool, outputs: int, given: NetworkBuilder | None = None) -> Network:
    """``outputs`` numbers for each action, one action after another, whatever the masks; the user's own network if one is ``given``."""
    if given is not None:
        return given(spec, actions * outputs)
    if shape.memory == "none":
        return q_values(spec.observation_space, actions, shape.net_arch, shape.activation, dueling, outputs, shape.layer_norm, shape.cnn)
    return _remembering(spec, shape, torch_uniform, QHead(actions, dueling, outputs))


def _remembering(spec: EnvSpec, shape: Shape, kernel_init: Callable[..., Array], head: nn.Module) -> Network:
    return remembering(
        Remembering(spec.observation_space, shape.net_arch, shape.activation, kernel_init, shape.memory, shape.memory_size, head, shape.cnn)
    )


def _pair(module: nn.Module) -> Network:
    return Network(
        init=lambda key, obs: module.init(key, obs)["params"],
        apply=lambda params, obs: module.apply({"params": params}, obs),
        layers=hidden_layers(module),
    )


def softmax_probabilities(network: Network, space: gymnasium.Space) -> Callable[[PyTree, PyTree, Observation], Float[Array, "*B n"]] | None:
    """Parameters, memory, obs -> the probability of each Discrete action, of a network that gives logits and a value; None for others."""
    if not isinstance(space, gymnasium.spaces.Discrete):
        return None
    return lambda params, memory, obs: nn.softmax(apply_step(network, params, memory, obs)[1][0])
