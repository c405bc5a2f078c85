"""Networks that say what a step is worth, from the observation acted on and the action: an ensemble of them, each a flat vector."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key

from thorndike.networks.dense import dense
from thorndike.networks.network import Network, flattened
from thorndike.networks.torso import Torso


class _Reward(nn.Module):
    """One number a row: pictures through convolutions first; leaky rectifiers, as Christiano et al. 2017 have them (appendix A)."""

    space: spaces.Box
    hidden: Sequence[int]

    @nn.compact
    def __call__(self, rows: tuple[Float[Array, "N ..."], Float[Array, "N A"]]) -> Float[Array, " N"]:
        obs, action = rows
        init = nn.initializers.orthogonal(2.0**0.5)
        seen = Torso(self.space, self.hidden[:1], "relu", init)(obs) if obs.ndim == 4 else obs
        x = jnp.concatenate([seen, action], axis=-1)
        for width in self.hidden:
            x = nn.leaky_relu(dense(width, init)(x))
        return dense(1, nn.initializers.orthogonal(1.0))(x)[:, 0]


def reward_network(obs: Float[Array, "1 ..."], action: Float[Array, "1 A"], hidden: Sequence[int]) -> Network:
    """A network on rows like these examples; its parameters are one flat vector."""
    module = _Reward(spaces.Box(-np.inf, np.inf, obs.shape[1:], np.float32), tuple(hidden))
    plain = Network(lambda key, rows: module.init(key, rows)["params"], lambda params, rows: module.apply({"params": params}, rows))
    flat = flattened(plain, (obs, action))
    return flat._replace(init=lambda key, rows: ravel_pytree(plain.init(key, rows))[0])


def number_of_parameters(network: Network, obs: Float[Array, "1 ..."], action: Float[Array, "1 A"]) -> int:
    """The length of its vector."""
    return int(jax.eval_shape(network.init, jax.random.key(0), (obs, action)).shape[0])


def initial_members(
    network: Network, obs: Float[Array, "1 ..."], action: Float[Array, "1 A"], members: int, key: Key[Array, ""]
) -> Float[Array, "E P"]:
    """Parameters of so many members. Consumes the key."""
    return jax.vmap(lambda one: network.init(one, (obs, action)))(jax.random.split(key, members))
