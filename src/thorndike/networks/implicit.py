"""A network that is asked for an action's return at any quantile level.

Dabney et al. 2018, "Implicit Quantile Networks" (arXiv:1806.06923), section 3.1: features of the observation times an embedding of the
level by cosines (eq. 4), then the last hidden layer and the outputs.
"""

from collections.abc import Sequence

import flax.linen as nn
import gymnasium
import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.networks.heads import combined
from thorndike.networks.hidden_layers import hidden_layers
from thorndike.networks.network import Network
from thorndike.networks.torso import ACTIVATIONS, MLP, Torso, torch_uniform
from thorndike.types import Observation

COSINES = 64
"""n in eq. 4."""


class ImplicitQuantiles(nn.Module):
    """Returns ``[B, A, N]`` at ``N`` quantile levels a row."""

    space: gymnasium.Space
    actions: int
    hidden: Sequence[int]
    activation: str
    dueling: bool
    cnn: str = "nature"

    @nn.compact
    def __call__(self, obs: Observation, fractions: Float[Array, "B N"]) -> Float[Array, "B A N"]:
        """Observation, quantile levels in [0, 1] to the return of every action at these levels."""
        features = Torso(self.space, self.hidden[:-1], self.activation, torch_uniform, cnn=self.cnn, name="torso")(obs)
        waves = jnp.cos(jnp.pi * jnp.arange(COSINES, dtype=jnp.float32)[None, None, :] * fractions[:, :, None])
        embedding = ACTIVATIONS[self.activation](nn.Dense(features.shape[-1], kernel_init=torch_uniform, name="levels")(waves))
        mixed = features[:, None, :] * embedding
        advantage = self._stream(mixed, self.actions, "advantage")
        if self.dueling:
            advantage = combined(self._stream(mixed, 1, "value"), advantage)
        return jnp.swapaxes(advantage, 1, 2)

    def _stream(self, mixed: Float[Array, "B N F"], outputs: int, name: str) -> Float[Array, "B N G"]:
        return MLP(self.hidden[-1:], self.activation, torch_uniform, outputs=outputs, name=name)(mixed)


def implicit_network(
    space: gymnasium.Space, actions: int, hidden: Sequence[int], activation: str, dueling: bool, cnn: str = "nature"
) -> Network:
    """The network of pairs ``(obs, fractions)``."""
    module = ImplicitQuantiles(space, actions, tuple(hidden), activation, dueling, cnn)
    look = hidden_layers(module)
    return Network(
        init=lambda key, seen: module.init(key, *seen)["params"],
        apply=lambda params, seen: module.apply({"params": params}, *seen),
        layers=lambda params, seen: look(params, *seen),
    )
