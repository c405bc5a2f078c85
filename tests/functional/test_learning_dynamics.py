"""Dead units, effective rank and gradient norms against slow loops, and on features made to have them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from thorndike.functional.learning_dynamics import dead, effective_rank, gradient_norms, mean_square_gradient, unit_metrics

RNG = np.random.default_rng(0)


def slow_dead(outputs, activation):
    rows = outputs.reshape(-1, outputs.shape[-1])
    found = []
    for unit in range(rows.shape[1]):
        says_nothing = True
        for row in rows:
            if (abs(row[unit]) <= 0.99) if activation == "tanh" else (row[unit] > 0):
                says_nothing = False
        found.append(says_nothing)
    return found


@pytest.mark.parametrize("shape", [(7, 12), (3, 2, 4, 12)], ids=["dense", "convolution"])
@pytest.mark.parametrize("activation", ["relu", "tanh", "silu"])
def test_dead_units_are_those_of_the_slow_loop(activation, shape):
    outputs = RNG.normal(0.3, 1.0, shape)
    outputs[..., 2], outputs[..., 5], outputs[..., 7] = -0.1, 0.995, -0.999
    outputs = np.tanh(5 * outputs) if activation == "tanh" else np.maximum(outputs, 0) if activation == "relu" else outputs
    outputs[..., 5] = 0.995
    found = np.asarray(dead(jnp.array(outputs, jnp.float32), activation))
    assert found.tolist() == slow_dead(outputs.astype(np.float32), activation)
    assert found[7] and (found[5] if activation == "tanh" else found[2])
    assert not found.all()


def slow_rank(features):
    values = np.linalg.eigvalsh(np.cov(np.asarray(features, np.float64).T, bias=True).reshape(features.shape[1], -1))
    return values.sum() ** 2 / (values**2).sum()


@pytest.mark.parametrize(("rows", "units"), [(50, 8), (6, 20), (30, 1)])
@pytest.mark.parametrize("size", [1.0, 1e-12, 1e12])
def test_the_effective_rank_is_that_of_the_covariances_eigenvalues(rows, units, size):
    features = RNG.normal(3.0, RNG.uniform(0.1, 2.0, units), (rows, units)).astype(np.float32)
    assert float(jax.jit(effective_rank)(jnp.array(features * np.float32(size)))) == pytest.approx(slow_rank(features), rel=1e-3)


@pytest.mark.parametrize("rank", [1, 3, 8])
def test_features_made_to_vary_in_some_directions_have_that_rank(rank):
    directions = np.linalg.qr(RNG.normal(size=(16, 16)))[0][:rank]
    places = np.linalg.qr(RNG.normal(size=(64, 64)))[0][:, :rank]
    centred = places - places.mean(0)
    features = np.linalg.qr(centred)[0] @ directions + 5.0
    assert float(effective_rank(jnp.array(features, jnp.float32))) == pytest.approx(rank, rel=1e-3)


def test_features_that_do_not_vary_have_none():
    assert float(effective_rank(jnp.full((5, 4), 2.0))) == 0.0


def test_units_are_counted_by_module_and_the_rank_is_of_its_last_layer():
    one, two = RNG.normal(size=(9, 4)).astype(np.float32), RNG.normal(size=(9, 6)).astype(np.float32)
    one, two = np.maximum(one, 0), np.maximum(two, 0)
    one[:, 0], two[:, :2] = 0, 0
    wave = np.tanh(RNG.normal(size=(9, 3))).astype(np.float32)
    layers = {"torso": {"MLP_0": {"relu": (jnp.array(one), jnp.array(two))}}, "value": {"tanh": (jnp.array(wave),)}}
    found = unit_metrics(layers)
    assert set(found) == {f"train/{name}/{module}" for name in ("dead_units", "effective_rank") for module in ("torso", "value")}
    assert float(found["train/dead_units/torso"]) == pytest.approx(3 / 10)
    assert float(found["train/dead_units/value"]) == 0
    assert float(found["train/effective_rank/torso"]) == pytest.approx(slow_rank(two), rel=1e-4)
    together = unit_metrics(layers, "critics")
    assert float(together["train/dead_units/critics"]) == pytest.approx(3 / 13)
    # The layers of the network itself come after those of its parts.
    assert float(together["train/effective_rank/critics"]) == pytest.approx(slow_rank(wave), rel=1e-4)


@pytest.mark.parametrize("optimizer", [optax.scale_by_adam(), optax.scale_by_radam()])
def test_the_norms_by_module_are_the_roots_of_the_mean_squared_gradients(optimizer):
    params = {"torso": {"kernel": jnp.zeros((2, 3)), "bias": jnp.zeros(3)}, "policy": {"kernel": jnp.zeros(3)}}
    state = optax.chain(optax.clip_by_global_norm(1e9), optimizer).init(params)
    gradients = [jax.tree.map(lambda x: jnp.array(RNG.normal(size=x.shape), jnp.float32), params) for _ in range(5)]
    mean, weight = 0.0, 0.0
    for age, gradient in enumerate(gradients):
        state = optax.chain(optax.clip_by_global_norm(1e9), optimizer).update(gradient, state)[1]
        share = 0.001 * 0.999 ** (len(gradients) - 1 - age)
        mean += share * sum(float(np.square(leaf).sum()) for leaf in gradient["torso"].values())
        weight += share
    found = gradient_norms(mean_square_gradient(state))
    assert set(found) == {"train/grad_norm/torso", "train/grad_norm/policy"}
    assert float(found["train/grad_norm/torso"]) == pytest.approx(np.sqrt(mean / weight), rel=1e-4)


class Parts(NamedTuple):
    body: object
    head: object


@pytest.mark.parametrize(
    ("tree", "modules"),
    [
        (2.0, {"all"}),
        ([{"weight": 1.0, "bias": 1.0}, {"weight": 1.0}], {"0/weight", "0/bias", "1/weight"}),
        ({"params": {"Dense_0": {"kernel": 1.0}, "Dense_1": {"kernel": 1.0}}}, {"Dense_0", "Dense_1"}),
        (Parts({"a": 1.0}, 1.0), {"body", "head"}),
        ([1.0, [1.0, 1.0]], {"0", "1/0", "1/1"}),
    ],
)
def test_modules_of_trees_of_any_kind_have_names(tree, modules):
    found = gradient_norms(jax.tree.map(jnp.asarray, tree))
    assert set(found) == {f"train/grad_norm/{module}" for module in modules}


def test_rmsprop_has_norms_too_and_an_optimiser_before_its_first_step_has_none():
    state = optax.scale_by_rms(decay=0.5).init(jnp.zeros(2))
    for _ in range(30):
        state = optax.scale_by_rms(decay=0.5).update(jnp.array([3.0, 4.0]), state)[1]
    assert float(gradient_norms(mean_square_gradient(state), "actor")["train/grad_norm/actor/all"]) == pytest.approx(5.0)
    fresh = optax.scale_by_adam().init((jnp.zeros(2), {"a": jnp.zeros(1)}))
    found = gradient_norms(mean_square_gradient(fresh))
    assert {name: float(value) for name, value in found.items()} == {"train/grad_norm/0": 0.0, "train/grad_norm/1/a": 0.0}
