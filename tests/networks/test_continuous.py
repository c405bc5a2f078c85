import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.errors import UserError
from thorndike.networks.continuous import box_dimensions, critics, policy_outputs
from thorndike.networks.network import Network, Recurrence
from thorndike.types import EnvSpec

BOX = spaces.Box(-1, 1, (2,), np.float32)


def spec_of(observation_space, action_space=BOX) -> EnvSpec:
    return EnvSpec("test-v0", observation_space, action_space, num_envs=1)


ROWS = spec_of(spaces.Box(-1, 1, (3,), np.float32))
DICT = spec_of(spaces.Dict({"place": spaces.Discrete(4), "speed": spaces.Box(-1, 1, (2,), np.float32)}))
IMAGE = spec_of(spaces.Box(0, 255, (40, 40, 1), np.uint8))


def seen(spec: EnvSpec, rows: int):
    return jax.tree.map(
        lambda *parts: jnp.stack([jnp.asarray(part) for part in parts]), *[spec.observation_space.sample() for _ in range(rows)]
    )


@pytest.mark.parametrize("spec", [ROWS, DICT, IMAGE], ids=["rows", "dict", "image"])
def test_an_ensemble_gives_what_each_critic_gives_alone(spec, quick_compile):
    net = critics(spec, 2, 3, (8,), "relu", outputs=5)

    @jax.jit
    def values_of(key, obs, action):
        params = net.init(key)
        return net.apply(params, obs, action), net.apply(params[1:2], obs, action), net.apply(params, obs, -action)

    values, alone, opposite = values_of(jax.random.key(0), seen(spec, 4), jnp.ones((4, 2)))
    assert values.shape == (3, 4, 5)
    assert not np.allclose(values[0], values[1]), "critics begin differently"
    np.testing.assert_allclose(alone[0], values[1], rtol=1e-5, atol=1e-6)
    assert not np.allclose(opposite, values), "the action matters"


def test_layer_normalisation_adds_its_scales_and_offsets():
    key = jax.random.key(0)
    plain, normalised = (jax.eval_shape(critics(ROWS, 2, 1, (8, 6), "relu", layer_norm=flag).init, key) for flag in (False, True))
    assert normalised.size - plain.size == 2 * (8 + 6)


def test_a_users_network_takes_the_place_of_the_policys():
    def given(spec, outputs):
        return Network(lambda key, obs: {"w": jnp.ones((3, outputs))}, lambda params, obs: obs @ params["w"])

    network, init = policy_outputs(ROWS, 4, (8,), "relu", given)
    params = init(jax.random.key(0))
    assert params.shape == (12,)
    np.testing.assert_allclose(network.apply(params, jnp.ones((2, 3))), 3.0)


def test_a_network_with_memory_is_refused():
    recurrence = Recurrence(lambda batch: (), lambda *_: ((), ()), lambda *_: ((), ()))
    with pytest.raises(UserError, match="no memory"):
        policy_outputs(ROWS, 4, (8,), "relu", lambda spec, outputs: Network(lambda key, obs: {}, lambda params, obs: obs, recurrence))


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(-1, 1, (2, 2), np.float32), spaces.Box(0, 9, (2,), np.int32)], ids=str)
def test_other_actions_than_one_row_of_floats_are_refused_in_one_line(space):
    with pytest.raises(UserError, match="td3 takes Box actions") as caught:
        box_dimensions("td3", spec_of(BOX, space))
    assert "\n" not in str(caught.value)
    assert box_dimensions("td3", ROWS) == 2
