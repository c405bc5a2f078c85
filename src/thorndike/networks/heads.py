"""Complete networks: a policy with its value, and Q-values."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import gymnasium
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.functional.action_distributions import ActionDistribution
from thorndike.networks.masking import masked
from thorndike.networks.network import Network, NetworkBuilder
from thorndike.networks.recurrent import Remembering, remembering
from thorndike.networks.torso import MLP, Torso, is_image, torch_uniform
from thorndike.types import EnvSpec, Observation


class ActorCritic(nn.Module):
    """Policy parameters ``[B, P]`` and a value ``[B]``, from two separate torsos, or one shared torso on images."""

    space: gymnasium.Space
    outputs: int
    free_parameters: int
    hidden: Sequence[int]
    activation: str
    log_std_init: float

    @nn.compact
    def __call__(self, obs: Observation) -> tuple[Float[Array, "B P"], Float[Array, " B"]]:
        """Observation ``[B, ...]`` to policy parameters and value."""
        hidden_init = nn.initializers.orthogonal(2.0**0.5)
        policy_torso = Torso(self.space, self.hidden, self.activation, hidden_init, name="policy_torso")
        features = policy_torso(obs)
        if is_image(self.space):
            value_features = features
        else:
            value_features = Torso(self.space, self.hidden, self.activation, hidden_init, name="value_torso")(obs)
        parameters = nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(0.01), name="policy")(features)
        value = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0), name="value")(value_features)
        if self.free_parameters:
            log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), (self.free_parameters,))
            spread = jnp.broadcast_to(log_std, (*parameters.shape[:-1], self.free_parameters))
            parameters = jnp.concatenate([parameters, spread], axis=-1)
        return parameters, value[..., 0]


class PolicyAndValue(nn.Module):
    """Policy parameters ``[B, P]`` and a value ``[B]`` from the same features: the head of a network with memory."""

    outputs: int
    free_parameters: int
    log_std_init: float

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> tuple[Float[Array, "B P"], Float[Array, " B"]]:
        """Features to policy parameters and value."""
        parameters = nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(0.01), name="policy")(features)
        value = nn.Dense(1, kernel_init=nn.initializers.orthogonal(1.0), name="value")(features)
        if self.free_parameters:
            log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), (self.free_parameters,))
            spread = jnp.broadcast_to(log_std, (*parameters.shape[:-1], self.free_parameters))
            parameters = jnp.concatenate([parameters, spread], axis=-1)
        return parameters, value[..., 0]


class QHead(nn.Module):
    """Q-values ``[B, A]`` from features; ``dueling`` as in ``QValues``."""

    actions: int
    dueling: bool

    @nn.compact
    def __call__(self, features: Float[Array, "B F"]) -> Float[Array, "B A"]:
        """Features to one value an action."""
        advantage = nn.Dense(self.actions, kernel_init=torch_uniform, name="q")(features)
        if not self.dueling:
            return advantage
        value = nn.Dense(1, kernel_init=torch_uniform, name="value")(features)
        return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


class QValues(nn.Module):
    """Q-values ``[B, A]``; ``dueling`` splits them into value and advantages (Wang et al. 2016, arXiv:1511.06581, eq. 9)."""

    space: gymnasium.Space
    actions: int
    hidden: Sequence[int]
    activation: str
    dueling: bool

    @nn.compact
    def __call__(self, obs: Observation) -> Float[Array, "B A"]:
        """Observation ``[B, ...]`` to one value an action."""
        shared = self.hidden[:-1] if self.dueling else self.hidden
        features = Torso(self.space, shared, self.activation, torch_uniform, name="torso")(obs)
        if not self.dueling:
            return nn.Dense(self.actions, kernel_init=torch_uniform, name="q")(features)
        last = self.hidden[-1:]
        value = MLP(last, self.activation, torch_uniform, outputs=1, name="value")(features)
        advantage = MLP(last, self.activation, torch_uniform, outputs=self.actions, name="advantage")(features)
        return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


def actor_critic(
    space: gymnasium.Space, outputs: int, free_parameters: int, hidden: Sequence[int], activation: str, log_std_init: float = 0.0
) -> Network:
    """A policy and its value. ``outputs`` is ``P`` less the ``free_parameters`` that do not depend on the observation."""
    return _pair(ActorCritic(space, outputs, free_parameters, tuple(hidden), activation, log_std_init))


def q_values(space: gymnasium.Space, actions: int, hidden: Sequence[int], activation: str, dueling: bool = False) -> Network:
    """Q-values of every action."""
    return _pair(QValues(space, actions, tuple(hidden), activation, dueling))


class Shape(NamedTuple):
    """The size of a network, in the words of the settings."""

    net_arch: tuple[int, ...]
    activation: str
    memory: str = "none"
    """``none``, ``gru`` or ``lstm``."""
    memory_size: int = 64


def policy_network(
    spec: EnvSpec, distribution: ActionDistribution, shape: Shape, log_std_init: float, given: NetworkBuilder | None = None
) -> Network:
    """A policy and its value for an environment, masks honoured; the user's own if one is ``given``."""
    if given is not None:
        return masked(given(spec, distribution.network_outputs + distribution.free_parameters), spec)
    outputs, free = distribution.network_outputs, distribution.free_parameters
    if shape.memory == "none":
        return masked(actor_critic(spec.observation_space, outputs, free, shape.net_arch, shape.activation, log_std_init), spec)
    return masked(_remembering(spec, shape, nn.initializers.orthogonal(2.0**0.5), PolicyAndValue(outputs, free, log_std_init)), spec)


def q_network(spec: EnvSpec, actions: int, shape: Shape, dueling: bool, given: NetworkBuilder | None = None) -> Network:
    """Q-values of every action, masks honoured; the user's own network if one is ``given``."""
    if given is not None:
        return masked(given(spec, actions), spec)
    if shape.memory == "none":
        return masked(q_values(spec.observation_space, actions, shape.net_arch, shape.activation, dueling), spec)
    return masked(_remembering(spec, shape, torch_uniform, QHead(actions, dueling)), spec)


def _remembering(spec: EnvSpec, shape: Shape, kernel_init: Callable[..., Array], head: nn.Module) -> Network:
    return remembering(
        Remembering(spec.observation_space, shape.net_arch, shape.activation, kernel_init, shape.memory, shape.memory_size, head)
    )


def _pair(module: nn.Module) -> Network:
    return Network(init=lambda key, obs: module.init(key, obs)["params"], apply=lambda params, obs: module.apply({"params": params}, obs))
