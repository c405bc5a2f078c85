"""Policy and value, Q-values: initial weights, shapes, the dueling identity."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.networks.heads import actor_critic, q_values

ROW = spaces.Box(-1, 1, (4,))
OBS = jax.random.normal(jax.random.key(5), (6, 4))


def test_policy_and_value_have_torsos_of_their_own_with_orthogonal_weights():
    network = actor_critic(ROW, 3, 0, (16, 16), "tanh")
    params = network.init(jax.random.key(0), OBS)
    assert set(params) == {"policy_torso", "value_torso", "policy", "value"}
    for torso in ("policy_torso", "value_torso"):
        first, second = (params[torso]["MLP_0"][layer]["kernel"] for layer in ("Dense_0", "Dense_1"))
        np.testing.assert_allclose(first @ first.T, 2 * np.eye(4), atol=1e-5)
        np.testing.assert_allclose(second @ second.T, 2 * np.eye(16), atol=1e-5)
    np.testing.assert_allclose(params["policy"]["kernel"].T @ params["policy"]["kernel"], 1e-4 * np.eye(3), atol=1e-7)
    np.testing.assert_allclose(params["value"]["kernel"].T @ params["value"]["kernel"], [[1.0]], rtol=1e-4)
    assert not any(np.any(leaf) for path, leaf in jax.tree.leaves_with_path(params) if "bias" in str(path))


def test_a_new_policy_is_nearly_uniform():
    network = actor_critic(ROW, 3, 0, (16,), "tanh")
    logits, value = network.apply(network.init(jax.random.key(0), OBS), OBS)
    assert logits.shape == (6, 3)
    assert value.shape == (6,)
    assert abs(jax.nn.softmax(logits) - 1 / 3).max() < 0.02


def test_log_deviations_are_free_parameters_beside_the_means():
    network = actor_critic(ROW, 2, 2, (8,), "tanh", log_std_init=-0.5)
    params = network.init(jax.random.key(0), OBS)
    np.testing.assert_array_equal(params["log_std"], [-0.5, -0.5])
    parameters, _ = network.apply(params | {"log_std": jnp.array([0.1, 0.2])}, OBS)
    np.testing.assert_allclose(parameters[:, 2:], np.tile([[0.1, 0.2]], (6, 1)), rtol=1e-6)


def test_policy_and_value_share_the_convolutions_of_an_image():
    network = actor_critic(spaces.Box(0, 255, (10, 10, 3), np.uint8), 2, 0, (8,), "relu")
    params = jax.eval_shape(network.init, jax.random.key(0), jax.ShapeDtypeStruct((1, 10, 10, 3), jnp.uint8))
    assert set(params) == {"policy_torso", "policy", "value"}


@pytest.mark.parametrize("dueling", [False, True])
def test_there_is_a_q_value_for_each_action(dueling):
    network = q_values(ROW, 5, (8, 8), "relu", dueling)
    assert jax.eval_shape(lambda key: network.apply(network.init(key, OBS), OBS), jax.random.key(0)).shape == (6, 5)


def test_dueling_removes_the_mean_advantage():
    network = q_values(ROW, 3, (8, 8), "relu", dueling=True)
    params = network.init(jax.random.key(0), OBS)
    q = network.apply(params, OBS)

    def add_to_bias(stream: str, amount: float) -> dict:
        layer = params[stream]["Dense_1"]
        return params | {stream: params[stream] | {"Dense_1": layer | {"bias": layer["bias"] + amount}}}

    np.testing.assert_allclose(network.apply(add_to_bias("advantage", 7.0), OBS), q, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(network.apply(add_to_bias("value", 7.0), OBS), q + 7, rtol=1e-4, atol=1e-5)
    # With the advantages' last layer at zero every action is worth the value: their mean.
    silent = params["advantage"] | {"Dense_1": jax.tree.map(jnp.zeros_like, params["advantage"]["Dense_1"])}
    only_value = network.apply(params | {"advantage": silent}, OBS)
    np.testing.assert_allclose(only_value, np.tile(np.mean(q, axis=1, keepdims=True), 3), rtol=1e-4, atol=1e-5)
