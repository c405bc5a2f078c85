"""From observations of every space to features: order, shapes, images, initial weights."""

from collections import OrderedDict

import flax.linen as nn
import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.networks.cnn import CNN
from thorndike.networks.convolution import Convolution, max_pool
from thorndike.networks.torso import MLP, Torso, flatten_observation, is_image, torch_uniform
from thorndike.training.space_files import space_from_json, space_to_json

BATCH = 3


def batch_of(space: spaces.Space, seed: int = 0) -> tuple:
    """Samples, and the same stacked as arrays of the dtypes a learner sees."""
    space.seed(seed)
    drawn = [space.sample() for _ in range(BATCH)]

    def array(*leaves):
        stacked = np.stack(leaves)
        if stacked.dtype.kind == "f":
            return jnp.asarray(stacked, jnp.float32)
        return jnp.asarray(stacked, stacked.dtype if stacked.dtype == np.uint8 else jnp.int32)

    return drawn, jax.tree.map(array, *drawn)


FLAT = [
    spaces.Box(-1, 1, (4,)),
    spaces.Box(-1, 1, ()),
    spaces.Box(-1, 1, (2, 3), np.float64),
    spaces.Discrete(5),
    spaces.Discrete(3, start=-1),
    spaces.MultiBinary(4),
    spaces.MultiBinary([2, 2]),
    spaces.MultiDiscrete([2, 3, 4]),
    spaces.MultiDiscrete([2, 3], start=[5, -2]),
    spaces.MultiDiscrete([[2, 3], [4, 2]]),
]


@pytest.mark.parametrize("space", FLAT, ids=str)
def test_a_plain_space_is_flattened_as_gymnasium_does(space):
    drawn, obs = batch_of(space)
    found = flatten_observation(space, obs)
    expected = [spaces.flatten(space, one) for one in drawn]
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, np.asarray(expected, np.float32).reshape(BATCH, -1), rtol=1e-6)


NESTED = spaces.Dict(
    {
        "z": spaces.Discrete(2),
        "a": spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.Dict({"inner": spaces.MultiDiscrete([2, 2])})]),
        "picture": spaces.Box(0, 255, (2, 2, 1), np.uint8),
    }
)


def test_nested_parts_lie_side_by_side_in_the_order_of_their_names():
    drawn, obs = batch_of(NESTED)
    found = flatten_observation(NESTED, obs)
    assert found.shape == (BATCH, 2 + 4 + 4 + 2)
    for row, one in zip(np.asarray(found), drawn, strict=True):
        inner = np.eye(2)[one["a"][1]["inner"]].ravel()
        expected = np.concatenate([one["a"][0], inner, one["picture"].ravel(), np.eye(2)[one["z"]]])
        np.testing.assert_allclose(row, expected)


def test_the_order_does_not_depend_on_how_the_dict_space_was_written():
    """A policy's space comes back from JSON with its names sorted: the features must not move."""
    written = spaces.Dict(OrderedDict([("b", spaces.Box(-1, 1, (2,))), ("a", spaces.Discrete(3))]))
    _, obs = batch_of(written)
    reread = space_from_json(space_to_json(written))
    np.testing.assert_array_equal(flatten_observation(written, obs), flatten_observation(reread, obs))


def test_leading_axes_are_kept():
    obs = jnp.arange(24.0).reshape(2, 3, 4)
    np.testing.assert_array_equal(flatten_observation(spaces.Box(0, 24, (4,)), obs), obs)
    assert flatten_observation(spaces.Discrete(3), jnp.zeros((2, 5), jnp.int32)).shape == (2, 5, 3)


def test_an_unknown_space_is_refused():
    with pytest.raises(UserError, match="observations may be Box"):
        flatten_observation(spaces.Text(5), jnp.zeros((1, 5)))


@pytest.mark.parametrize(
    ("space", "image"),
    [
        (spaces.Box(0, 255, (84, 84), np.uint8), True),
        (spaces.Box(0, 255, (84, 84, 4), np.uint8), True),
        (spaces.Box(0, 1, (10, 10, 4)), True),
        (spaces.Box(0, 1, (10, 10)), False),
        (spaces.Box(0, 255, (84,), np.uint8), False),
        (NESTED, False),
    ],
)
def test_images_are_told_from_rows(space, image):
    assert is_image(space) is image


@pytest.mark.parametrize(
    ("size", "kernels"),
    [
        ((84, 84, 4), [(8, 8, 4, 32), (4, 4, 32, 64), (3, 3, 64, 64), (7 * 7 * 64, 128)]),
        ((36, 36, 1), [(8, 8, 1, 32), (4, 4, 32, 64), (3, 3, 64, 64), (64, 128)]),
        ((10, 10, 4), [(3, 3, 4, 16), (8 * 8 * 16, 128)]),
    ],
)
def test_large_images_get_the_nature_network_and_small_ones_one_layer(size, kernels):
    module, image = CNN((128,), jax.nn.initializers.orthogonal()), jax.ShapeDtypeStruct((2, *size), jnp.float32)
    features, variables = jax.eval_shape(lambda key, x: module.init_with_output(key, x), jax.random.key(0), image)
    assert features.shape == (2, 128)
    assert sorted(layer["kernel"].shape for layer in variables["params"].values()) == sorted(kernels)


def test_the_dense_layers_after_convolutions_are_those_asked_for():
    torso = Torso(spaces.Box(0, 1, (10, 10, 4), bool), (32, 8), "tanh", torch_uniform)
    features, variables = torso.init_with_output(jax.random.key(0), jnp.ones((2, 10, 10, 4), bool))
    assert features.shape == (2, 8)
    layers = variables["params"]["CNN_0"]
    assert {name: layers[name]["kernel"].shape for name in ("Dense_0", "Dense_1")} == {"Dense_0": (1024, 32), "Dense_1": (32, 8)}


def test_without_convolutions_an_image_goes_straight_to_the_dense_layers():
    space = spaces.Box(0, 1, (10, 10, 4), bool)
    torso = Torso(space, (8,), "relu", torch_uniform, cnn="none")
    board = jax.random.bernoulli(jax.random.key(0), 0.3, (3, 10, 10, 4))
    params = torso.init(jax.random.key(1), board)
    (layer,) = jax.tree.leaves(params, is_leaf=lambda x: "kernel" in x)
    expected = np.maximum(np.asarray(board, np.float32).reshape(3, -1) @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]), 0)
    np.testing.assert_allclose(torso.apply(params, board), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("size", "stride", "same", "batch"),
    [(3, 1, False, 5), (4, 2, False, 5), (8, 4, False, 5), (3, 2, False, 5), (3, 1, True, 5), (4, 2, False, 515)],
)
def test_a_convolution_is_flaxs_forward_and_backward(size, stride, same, batch):
    image = jax.random.normal(jax.random.key(1), (batch, 11, 14, 2))
    mine = Convolution(6, size, stride, torch_uniform, same)
    theirs = nn.Conv(6, (size, size), (stride, stride), padding="SAME" if same else "VALID", kernel_init=torch_uniform)
    variables = theirs.init(jax.random.key(0), image)
    assert jax.tree.all(jax.tree.map(np.array_equal, variables, mine.init(jax.random.key(0), image)))
    variables["params"]["bias"] = jnp.arange(6.0)
    found, expected = (jax.vjp(module.apply, variables, image) for module in (mine, theirs))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-4, atol=1e-4)
    weight = jax.random.normal(jax.random.key(2), found[0].shape)
    for ours, other in zip(jax.tree.leaves(found[1](weight)), jax.tree.leaves(expected[1](weight)), strict=True):
        np.testing.assert_allclose(ours, other, rtol=1e-3, atol=1e-3 * batch**0.5)


@pytest.mark.parametrize("shape", [(84, 84), (21, 10), (5, 4)])
def test_the_maximum_of_windows_is_flaxs(shape):
    image = jax.random.normal(jax.random.key(1), (2, *shape, 3))
    np.testing.assert_array_equal(max_pool(image), nn.max_pool(image, (3, 3), (2, 2), padding="SAME"))


def test_the_impala_network_has_fifteen_convolutions_and_adds_to_what_it_is_given():
    module, image = CNN((256,), jax.nn.initializers.zeros, kind="impala"), jax.ShapeDtypeStruct((2, 84, 84, 4), jnp.float32)
    features, variables = jax.eval_shape(lambda key, x: module.init_with_output(key, x), jax.random.key(0), image)
    shapes = [layer["kernel"].shape for layer in variables["params"].values()]
    assert features.shape == (2, 256)
    expected = [(3, 3, a, b) for a, b in ((4, 16), *[(16, 16)] * 4, (16, 32), *[(32, 32)] * 9)]
    assert sorted(shapes) == sorted([*expected, (11 * 11 * 32, 256)])


def test_stacks_with_channels_first_reach_the_network_with_channels_last():
    stack = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, 4, 40, 44)), jnp.uint8)
    first, last = (Torso(spaces.Box(0, 255, shape, np.uint8), (8,), "relu", torch_uniform) for shape in ((4, 40, 44), (40, 44, 4)))
    found, variables = first.init_with_output(jax.random.key(0), stack)
    assert variables["params"]["CNN_0"]["Conv_0"]["kernel"].shape == (8, 8, 4, 32)
    np.testing.assert_array_equal(last.apply(variables, jnp.moveaxis(stack, 1, -1)), found)


def test_pixels_are_scaled_to_1_and_a_grey_image_gets_a_channel():
    space = spaces.Box(0, 255, (6, 6), np.uint8)
    torso = Torso(space, (8,), "relu", torch_uniform)
    grey = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, 6, 6)), jnp.uint8)
    found, variables = torso.init_with_output(jax.random.key(0), grey)
    assert variables["params"]["CNN_0"]["Conv_0"]["kernel"].shape == (3, 3, 1, 16)
    # The same picture as floats in [0, 1], through the space of floats.
    floats = Torso(spaces.Box(0, 1, (6, 6, 1)), (8,), "relu", torch_uniform)
    np.testing.assert_allclose(floats.apply(variables, grey[..., None] / 255.0), found, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("fan_in", [3, 100])
def test_torch_uniform_fills_plus_minus_one_over_the_root_of_fan_in(fan_in):
    weights = np.asarray(torch_uniform(jax.random.key(0), (fan_in, 2000)))
    bound = fan_in**-0.5
    assert abs(weights).max() <= bound
    assert abs(weights).max() > 0.99 * bound
    np.testing.assert_allclose(weights.std(), bound / 3**0.5, rtol=0.03)


def test_a_perceptron_activates_every_layer_but_its_outputs():
    module, x = MLP((8, 8), "relu", torch_uniform, outputs=3), jax.random.normal(jax.random.key(1), (BATCH, 5))
    params = module.init(jax.random.key(0), x)["params"]
    expected = x
    for name in ("Dense_0", "Dense_1"):
        expected = np.maximum(expected @ params[name]["kernel"] + params[name]["bias"][None], 0)
    expected = expected @ params["Dense_2"]["kernel"] + params["Dense_2"]["bias"][None]
    np.testing.assert_allclose(module.apply({"params": params}, x), expected, rtol=1e-4, atol=1e-5)
