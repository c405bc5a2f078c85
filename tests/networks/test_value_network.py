"""The deep Q-learners' networks: shapes, noisy weights, implicit quantiles, dueling, masks."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from thorndike.errors import UserError
from thorndike.functional.distributional import categorical, expected_value, implicit_quantiles, quantiles
from thorndike.networks.heads import Shape, combined, q_values
from thorndike.networks.masking import FORBIDDEN
from thorndike.networks.noisy import noise_of
from thorndike.networks.value_network import Form, value_network
from thorndike.types import EnvSpec

ACTIONS, ROWS = 3, 5
SPEC = EnvSpec("row", spaces.Box(-1, 1, (4,)), spaces.Discrete(ACTIONS), 2)
OBS = jax.random.normal(jax.random.key(5), (ROWS, 4))
SHAPE = Shape((8, 8), "relu")
PLAIN, NOISY = Form(False, None, False), Form(True, 0.5, False)


@pytest.mark.parametrize(
    ("distribution", "dueling", "memory"),
    [(expected_value(), False, "none"), (categorical(-1.0, 1.0, 7), True, "none"), (quantiles(6), True, "gru")],
    ids=["mean", "c51", "qr"],
)
def test_every_action_has_its_numbers(distribution, dueling, memory):
    net = value_network(SPEC, ACTIONS, SHAPE._replace(memory=memory, memory_size=4), Form(dueling, 0.5, False), distribution)
    params = jax.eval_shape(net.init, jax.random.key(0))
    outputs = jax.eval_shape(lambda params: net.network.apply(net.means(params), OBS), params)
    assert outputs.shape == (ROWS, ACTIONS, distribution.outputs)
    assert jax.eval_shape(lambda out: net.q(out, OBS), outputs).shape == (ROWS, ACTIONS)


def test_dueling_takes_the_mean_over_actions_from_each_number():
    value, advantage = jax.random.normal(jax.random.key(0), (ROWS, 4)), jax.random.normal(jax.random.key(1), (ROWS, ACTIONS * 4))
    rows = np.asarray(advantage).reshape(ROWS, ACTIONS, 4)
    expected = np.asarray(value)[:, None] + rows - rows.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(combined(value, advantage), expected.reshape(ROWS, -1), atol=1e-6)


def test_noise_is_factorised_and_its_spread_is_sigma_over_the_root_of_the_inputs():
    """Fortunato et al. 2018, eq. 10 and 11, and section 3.2."""
    params = {"first": {"kernel": jnp.zeros((4, 3)), "bias": jnp.zeros(3)}, "other": {"scale": jnp.zeros(2)}}
    noise = noise_of(params, 0.5)
    assert noise.size == 7
    numbers = jnp.array([4.0, -1.0, 0.0, 9.0, 1.0, -4.0, 0.25])
    squashed = np.sign(numbers) * np.sqrt(np.abs(numbers))
    found = noise.shaped(numbers)
    np.testing.assert_allclose(found["first"]["bias"], squashed[4:], rtol=1e-6)
    np.testing.assert_allclose(found["first"]["kernel"], np.outer(squashed[:4], squashed[4:]), rtol=1e-6)
    np.testing.assert_array_equal(found["other"]["scale"], 0)
    np.testing.assert_allclose(ravel_pytree(noise.spread)[0], [0.25] * 15 + [0] * 2)


def test_noisy_weights_scatter_around_their_means_by_their_spread():
    net = value_network(SPEC, ACTIONS, SHAPE, NOISY, expected_value())
    params = net.init(jax.random.key(0))
    means, spreads = np.split(np.asarray(params), 2)
    draw = jax.vmap(lambda numbers: ravel_pytree(net.drawn(params, numbers))[0])
    drawn = np.asarray(draw(jax.random.normal(jax.random.key(1), (4000, net.noise_size))))
    np.testing.assert_array_equal(ravel_pytree(net.means(params))[0], means)
    assert np.abs(drawn.mean(axis=0) - means).max() < 0.05
    # A kernel's noise is a product of two factors whose squares are E|x| = sqrt(2 / pi) on average; a bias has one.
    factor = np.sqrt(2 / np.pi)
    assert abs(np.median(drawn.std(axis=0) / spreads) - factor) < 0.05


def test_implicit_quantiles_are_asked_for_at_the_levels_given_and_judged_at_fixed_ones():
    net = value_network(SPEC, ACTIONS, SHAPE, Form(True, None, True), implicit_quantiles(4))
    weights = net.means(net.init(jax.random.key(0)))
    levels = jnp.tile(jnp.array([[0.1, 0.9, 0.1, 0.5]]), (ROWS, 1))
    outputs = net.at(weights, OBS, levels)
    assert outputs.shape == (ROWS, ACTIONS, 4)
    np.testing.assert_allclose(outputs[..., 0], outputs[..., 2], rtol=1e-5)
    assert np.abs(outputs[..., 0] - outputs[..., 1]).max() > 1e-4
    again = net.network.apply(weights, OBS)
    assert again.shape == (ROWS, ACTIONS, 32)
    np.testing.assert_array_equal(again, net.network.apply(weights, OBS))


@pytest.mark.parametrize("distribution", [expected_value(), categorical(-1.0, 1.0, 7), quantiles(6)], ids=["mean", "c51", "qr"])
def test_forbidden_actions_are_the_worst_whatever_the_form_of_returns(distribution):
    masked = EnvSpec("m", spaces.Dict({"observation": SPEC.observation_space, "action_mask": spaces.MultiBinary(3)}), SPEC.action_space, 2)
    net = value_network(masked, ACTIONS, SHAPE, PLAIN, distribution)
    obs = {"observation": OBS, "action_mask": jnp.tile(jnp.array([[1, 0, 1]], jnp.int8), (ROWS, 1))}
    outputs = net.network.apply(net.means(net.init(jax.random.key(0))), obs)
    q = np.asarray(net.q(outputs, obs))
    np.testing.assert_array_equal(q[:, 1], FORBIDDEN)
    assert np.abs(q[:, [0, 2]]).max() < 100 and np.abs(outputs).max() < 100


def test_a_network_of_ones_own_has_all_numbers_of_all_actions_side_by_side():
    net = value_network(
        SPEC, ACTIONS, SHAPE, PLAIN, quantiles(2), lambda spec, outputs: q_values(spec.observation_space, outputs, (4,), "relu")
    )
    assert net.network.apply(net.means(net.init(jax.random.key(0))), OBS).shape == (ROWS, ACTIONS, 2)
    with pytest.raises(UserError, match="own network"):
        value_network(SPEC, ACTIONS, SHAPE._replace(memory="gru"), Form(False, None, True), implicit_quantiles(4))


def test_layers_are_normalised_where_asked():
    params = q_values(SPEC.observation_space, 2, (8, 8), "relu", layer_norm=True).init(jax.random.key(0), OBS)
    assert {"LayerNorm_0", "LayerNorm_1"} <= set(params["torso"]["MLP_0"])
