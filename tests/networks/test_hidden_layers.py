"""Networks that lay their hidden layers open: made to have dead units, they say so, whatever they are wrapped in."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.action_distributions import categorical
from thorndike.functional.descent import Optimized
from thorndike.functional.distributional import expected_value
from thorndike.networks.batch_renorm import renormalized_network
from thorndike.networks.continuous import critics
from thorndike.networks.heads import Shape, policy_network, q_values
from thorndike.networks.hidden_layers import ROWS, look_into, some_rows
from thorndike.networks.network import Network, flattened
from thorndike.networks.torso import example_observation
from thorndike.networks.value_network import Form, value_network
from thorndike.types import EnvSpec

SPACE = gymnasium.spaces.Box(-1, 1, (3,))
OBS = jnp.array(np.random.default_rng(1).uniform(-1, 1, (40, 3)), jnp.float32)
KEY = jax.random.key(0)


def killed(params, where, units):
    """The same parameters, with units of a dense layer that can never be active."""
    layer = params
    for name in where[:-1]:
        layer = layer[name]
    bias = layer[where[-1]]["bias"].at[jnp.arange(units)].set(-100.0)
    layer[where[-1]] = {**layer[where[-1]], "bias": bias}
    return params


@pytest.mark.parametrize("flat", [False, True])
def test_a_network_made_to_have_dead_units_says_so(flat):
    network = q_values(SPACE, 2, (8, 4), "relu")
    params = killed(network.init(KEY, OBS), ("torso", "MLP_0", "Dense_0"), 3)
    squares = jax.tree.map(jnp.ones_like, params)
    if flat:
        params, network = jax.flatten_util.ravel_pytree(params)[0], flattened(network, example_observation(SPACE))
        squares = jnp.ones_like(params)
    found = look_into(network, params, OBS, squares)
    sizes = {"train/grad_norm/torso": 3 * 8 + 8 + 8 * 4 + 4, "train/grad_norm/q": 4 * 2 + 2}
    assert {name: float(value) ** 2 for name, value in found.items() if name in sizes} == pytest.approx(sizes)
    alive = np.asarray(network.apply(params, OBS)).shape == (40, 2)
    assert alive and float(found["train/dead_units/torso"]) >= 3 / 12
    hidden = np.asarray(jax.tree.leaves(network.layers(params, OBS))[0])
    assert (hidden[:, :3] == 0).all() and hidden.shape == (40, 8)


def test_saturated_tanh_units_of_either_torso_are_told_apart():
    spec = EnvSpec("e", SPACE, gymnasium.spaces.Discrete(2), 4)
    network = policy_network(spec, categorical(2), Shape((8, 8), "tanh"), 0.0)
    params = killed(network.init(KEY, OBS), ("value_torso", "MLP_0", "Dense_1"), 8)
    found = look_into(network, params, OBS, params)
    assert float(found["train/dead_units/value_torso"]) == pytest.approx(0.5)
    assert float(found["train/dead_units/policy_torso"]) == 0.0
    assert float(found["train/effective_rank/value_torso"]) == 0.0 < float(found["train/effective_rank/policy_torso"])
    assert {"train/grad_norm/policy", "train/grad_norm/value", "train/grad_norm/policy_torso"} <= set(found)


def test_networks_with_memory_show_their_torsos():
    spec = EnvSpec("e", SPACE, gymnasium.spaces.Discrete(2), 4)
    network = policy_network(spec, categorical(2), Shape((8,), "tanh", "gru", 4), 0.0)
    found = look_into(network, params := network.init(KEY, OBS), OBS, params)
    assert {"train/dead_units/0", "train/effective_rank/1", "train/grad_norm/0/recurrent", "train/grad_norm/1/torso"} <= set(found)


@pytest.mark.parametrize("form", [Form(True, 0.5, False), Form(False, None, True)], ids=["noisy, dueling", "implicit"])
def test_value_networks_of_every_form_show_their_layers(form):
    spec = EnvSpec("e", SPACE, gymnasium.spaces.Discrete(2), 4)
    net = value_network(spec, 2, Shape((8, 8), "relu"), form, expected_value())
    weights = net.means(net.init(KEY))
    found = look_into(net.network, weights, OBS, weights)
    assert {"train/dead_units/torso", "train/dead_units/advantage", "train/grad_norm/torso", "train/grad_norm/advantage"} <= set(found)


def test_of_critics_and_renormalised_networks_the_mean_is_told():
    spec, action = EnvSpec("e", SPACE, SPACE, 4), OBS
    net = critics(spec, 3, 2, (6,), "relu")
    params = net.init(KEY)
    state = {"nu": jnp.full(params.shape, 4.0), "count": jnp.array(100_000)}
    found = net.look(Optimized(params, state), OBS, action)
    assert 0.0 <= float(found["train/dead_units/critics"]) < 1.0
    assert float(found["train/grad_norm/critics/Dense_0"]) == pytest.approx(2 * np.sqrt(6 * 6 + 6), rel=1e-4)
    renormalised = renormalized_network(3, 1, (6,), "relu", 10)
    flat, moments = renormalised.init(KEY)
    told = renormalised.look("actor", flat[None], moments[None], jnp.ones((1, flat.size)), OBS)
    assert {"train/dead_units/actor", "train/effective_rank/actor", "train/grad_norm/actor/Dense_0"} <= set(told)


def test_a_users_network_that_shows_nothing_has_its_norms_alone():
    own = Network(lambda key, obs: {"w": jnp.ones(3)}, lambda params, obs: obs @ params["w"][:, None])
    assert set(look_into(own, {"w": jnp.ones(3)}, OBS, {"w": jnp.ones(3)})) == {"train/grad_norm/w"}


def test_of_long_rollouts_some_rows_are_looked_at():
    obs = {"a": jnp.arange(300 * 4).reshape(300, 4)}
    rows = some_rows(obs)["a"]
    assert rows.tolist() == list(range(0, 1200, 3)) and len(rows) <= ROWS
    assert some_rows(obs["a"][:2]).tolist() == list(range(8))
