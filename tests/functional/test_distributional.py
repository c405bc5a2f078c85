"""Return distributions against loops in NumPy, and what each form promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.distributional import (
    categorical,
    categorical_projection,
    expected_value,
    huber,
    implicit_quantiles,
    midpoints,
    quantile_huber,
    quantiles,
    two_hot,
)

RNG = np.random.default_rng(3)
M, ACTIONS, ATOMS = 6, 3, 11
SUPPORT = jnp.linspace(-2.0, 3.0, ATOMS)
FORMS = {"expected value": expected_value(), "c51": categorical(-2.0, 3.0, ATOMS), "qr": quantiles(8), "iqn": implicit_quantiles(8)}


def probabilities(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.dirichlet(np.ones(ATOMS), shape), jnp.float32)


def numbers(*shape: int) -> jax.Array:
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


def projected_by_hand(probability, reward, discount) -> np.ndarray:
    """Bellemare et al. 2017, algorithm 1, atom by atom."""
    out, width = np.zeros((len(reward), ATOMS)), (SUPPORT[-1] - SUPPORT[0]) / (ATOMS - 1)
    probability, reward, discount, support = map(np.asarray, (probability, reward, discount, SUPPORT))
    for row in range(len(reward)):
        for j in range(ATOMS):
            place = (np.clip(reward[row] + discount[row] * support[j], support[0], support[-1]) - support[0]) / width
            below, above = int(np.floor(place)), int(np.ceil(place))
            if below == above:
                out[row, below] += probability[row, j]
            else:
                out[row, below] += probability[row, j] * (above - place)
                out[row, above] += probability[row, j] * (place - below)
    return out


def quantile_loss_by_hand(predicted, fractions, target, kappa) -> np.ndarray:
    predicted, fractions, target = map(np.asarray, (predicted, fractions, target))
    out = np.zeros(len(predicted))
    for row in range(len(predicted)):
        for i, tau in enumerate(fractions[row]):
            for value in target[row]:
                u = value - predicted[row, i]
                smooth = 0.5 * u * u if abs(u) <= kappa else kappa * (abs(u) - 0.5 * kappa)
                out[row] += abs(tau - (u < 0)) * smooth / kappa / len(target[row])
    return out


@pytest.mark.parametrize("compiled", [False, True])
def test_the_projection_is_that_of_a_loop_over_atoms(compiled):
    reward, discount = 2.0 * numbers(M), jnp.array([0.99, 0.0, 0.5, 0.9, 1.0, 0.0])
    project = jax.jit(categorical_projection) if compiled else categorical_projection
    found = project(probability := probabilities(M), reward, discount, SUPPORT)
    np.testing.assert_allclose(found, projected_by_hand(probability, reward, discount), atol=2e-5)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=2e-5)


def test_a_projection_keeps_the_mean_of_what_stays_on_the_support():
    probability = jnp.zeros((1, ATOMS)).at[0, 4:7].set(jnp.array([0.2, 0.5, 0.3]))
    found = categorical_projection(probability, jnp.array([0.13]), jnp.array([0.9]), SUPPORT)
    np.testing.assert_allclose(found @ SUPPORT, 0.13 + 0.9 * (probability @ SUPPORT), rtol=1e-5)


@pytest.mark.parametrize("kappa", [1.0, 0.3])
@pytest.mark.parametrize("compiled", [False, True])
def test_the_quantile_loss_is_that_of_a_loop_over_pairs(kappa, compiled):
    predicted, target, fractions = 2 * numbers(M, 5), 2 * numbers(M, 7), jnp.asarray(RNG.uniform(size=(M, 5)), jnp.float32)
    loss = jax.jit(quantile_huber, static_argnums=3) if compiled else quantile_huber
    np.testing.assert_allclose(
        loss(predicted, fractions, target, kappa), quantile_loss_by_hand(predicted, fractions, target, kappa), rtol=1e-5
    )


def test_the_quantile_loss_is_least_at_the_quantiles():
    target = jnp.sort(numbers(1, 1001))
    fractions, kappa = midpoints(4)[None], 1e-3
    best = jnp.quantile(target[0], fractions[0])[None]
    np.testing.assert_allclose(jax.grad(lambda predicted: quantile_huber(predicted, fractions, target, kappa)[0])(best), 0, atol=5e-3)


def test_huber_is_quadratic_then_linear():
    np.testing.assert_allclose(huber(jnp.array([-3.0, -0.5, 0.0, 1.0, 2.0]), 1.0), [2.5, 0.125, 0.0, 0.5, 1.5])


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_policy_that_is_sure_follows_its_action_and_gradients_flow_into_the_prediction_alone(form):
    outputs, following = numbers(M, ACTIONS, form.outputs), numbers(M, ACTIONS, form.outputs)
    sure = jnp.eye(ACTIONS)[jnp.array([0, 1, 2, 0, 1, 2])]
    reward, discount = numbers(M), jnp.full((M,), 0.9)
    fractions = form.fractions(jax.random.key(0), M)
    assert fractions.shape == (M, form.outputs)

    def loss(predicted, following):
        return form.errors(predicted, fractions, form.mix(following, sure), reward, discount).loss.sum()

    chosen = outputs[:, 0]
    into_prediction, into_target = jax.grad(loss, argnums=(0, 1))(chosen, following)
    assert np.abs(into_prediction).max() > 0
    np.testing.assert_array_equal(into_target, 0)
    assert form.mean(outputs).shape == (M, ACTIONS)


@pytest.mark.parametrize("name", ["expected value", "c51", "qr"])
def test_gradient_descent_on_the_errors_finds_the_expected_return(name):
    """Rewards 0 and 1, equally likely, at the end of an episode: the mean is a half, whatever describes it."""
    form = FORMS[name]
    reward, nothing, following = jnp.array([0.0, 1.0]), jnp.zeros(2), jnp.full((2, form.outputs), 1 / form.outputs)
    fractions = form.fractions(jax.random.key(0), 2)

    def loss(outputs):
        return form.errors(jnp.tile(outputs[None], (2, 1)), fractions, following, reward, nothing).loss.mean()

    step = jax.jit(lambda outputs: outputs - 0.1 * jax.grad(loss)(outputs))
    outputs = jnp.linspace(-1.0, 1.5, form.outputs)
    for _ in range(1000):
        outputs = step(outputs)
    assert abs(float(form.mean(outputs[None])[0]) - 0.5) < 0.02


def test_c51_says_the_mean_of_its_atoms():
    form, logits = FORMS["c51"], numbers(M, ACTIONS, ATOMS)
    weights = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(form.mean(logits), weights @ SUPPORT, rtol=1e-4, atol=1e-5)
    third = jnp.full((M, ACTIONS), 1 / ACTIONS)
    np.testing.assert_allclose(form.mix(logits, third), weights.mean(axis=1), rtol=1e-4)


def test_two_hot_puts_a_number_between_its_neighbours():
    inside = np.concatenate([RNG.uniform(-2, 3, 20), [-2.0, 3.0, -9.0, 9.0, -1.5]]).astype(np.float32)
    by_hand = projected_by_hand(np.eye(ATOMS)[np.zeros(len(inside), int)], inside, np.zeros(len(inside)))
    shaped = jax.jit(two_hot)(jnp.asarray(inside).reshape(5, 5), SUPPORT)
    np.testing.assert_allclose(shaped.reshape(-1, ATOMS), by_hand, atol=1e-6)
