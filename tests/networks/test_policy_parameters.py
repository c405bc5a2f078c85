"""What a policy depends on, found in networks of every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from jax.flatten_util import ravel_pytree

from thorndike.networks.heads import actor_critic
from thorndike.networks.network import Network
from thorndike.networks.policy_parameters import reaches_policy
from thorndike.networks.torso import example_observation


def by_part(network: Network, example) -> dict[str, bool]:
    params = network.init(jax.random.key(0), example)
    mask = ravel_pytree(params)[1](jnp.asarray(reaches_policy(network, example), jnp.float32))
    return {name: bool(np.all(ravel_pytree(part)[0])) for name, part in mask.items() if ravel_pytree(part)[0].size}


@pytest.mark.parametrize(
    ("space", "shared"), [(spaces.Box(-1, 1, (3,), np.float32), False), (spaces.Box(0, 255, (36, 36, 1), np.uint8), True)]
)
def test_a_shared_torso_belongs_to_the_policy_and_a_value_of_its_own_does_not(space, shared):
    found = by_part(actor_critic(space, 2, 2, (8,), "tanh"), example_observation(space))
    expected = {"policy_torso": True, "policy": True, "value": False, "log_std": True}
    assert found == expected | ({} if shared else {"value_torso": False})


def test_a_network_of_ones_own_that_is_compiled_as_a_whole():
    @jax.jit
    def apply(params, obs):
        return obs @ params["body"] @ params["policy"], (obs @ params["body"] @ params["value"])[:, 0]

    shapes = {"body": (3, 4), "policy": (4, 2), "value": (4, 1)}
    network = Network(lambda key, obs: {name: jnp.ones(shape) for name, shape in shapes.items()}, apply)
    assert by_part(network, jnp.zeros((1, 3))) == {"body": True, "policy": True, "value": False}
