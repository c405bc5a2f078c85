"""Complete networks: a policy with its value, and Q-values."""

from collections.abc import Sequence

import flax.linen as nn
import gymnasium
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.networks.network import Network
from thorndike.networks.torso import MLP, Torso, is_image, torch_uniform
from thorndike.types import Observation


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


def _pair(module: nn.Module) -> Network:
    return Network(init=lambda key, obs: module.init(key, obs)["params"], apply=lambda params, obs: module.apply({"params": params}, obs))
