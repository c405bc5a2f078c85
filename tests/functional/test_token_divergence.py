"""Estimators of the divergence between two models, beside loops and beside the exact value over the vocabulary."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.functional.policy_divergence import categorical_divergence
from thorndike.functional.token_divergence import k1, k2, k3, weighted_text_mean

RNG = np.random.default_rng(0)
FIRST, SECOND = (RNG.normal(0, 0.5, (4, 6, 12)).astype(np.float32) for _ in range(2))


def log_softmax(row: np.ndarray) -> np.ndarray:
    return row - math.log(np.exp(row.astype(np.float64)).sum())


def test_estimators_are_their_formulas() -> None:
    p, q = RNG.normal(-2, 1, (5, 7)).astype(np.float32), RNG.normal(-2, 1, (5, 7)).astype(np.float32)
    for estimator, formula in [
        (k1, lambda p, q: p - q),
        (k2, lambda p, q: (p - q) ** 2 / 2),
        (k3, lambda p, q: math.exp(q) / math.exp(p) - 1 - (q - p)),
    ]:
        wanted = [[formula(float(p[row, column]), float(q[row, column])) for column in range(7)] for row in range(5)]
        np.testing.assert_allclose(estimator(jnp.asarray(p), jnp.asarray(q)), wanted, rtol=2e-5, atol=2e-6)


def test_the_exact_value_is_a_sum_over_the_vocabulary_and_never_negative() -> None:
    found = np.asarray(categorical_divergence(jnp.asarray(FIRST), jnp.asarray(SECOND)))
    for text in range(4):
        for place in range(6):
            p, q = log_softmax(FIRST[text, place]), log_softmax(SECOND[text, place])
            assert found[text, place] == np.float32(found[text, place]) >= 0
            assert abs(found[text, place] - sum(math.exp(a) * (a - b) for a, b in zip(p, q, strict=True))) < 1e-5
    np.testing.assert_allclose(categorical_divergence(jnp.asarray(FIRST), jnp.asarray(FIRST)), 0.0, atol=1e-6)


def test_sampled_estimators_agree_with_the_exact_value() -> None:
    p, q = (jax.nn.log_softmax(jnp.asarray(logits[0, 0])) for logits in (FIRST, SECOND))
    exact = float(categorical_divergence(jnp.asarray(FIRST[0, 0]), jnp.asarray(SECOND[0, 0])))
    tokens = jax.random.categorical(jax.random.key(0), p, shape=(200_000,))
    for estimator in (k1, k3):
        values = np.asarray(estimator(p[tokens], q[tokens]))
        assert abs(values.mean() - exact) < 3 * values.std() / math.sqrt(len(values))
    assert float(k3(p[tokens], q[tokens]).min()) >= 0 > float(k1(p[tokens], q[tokens]).min())


def test_the_gradient_of_k2_is_that_of_the_divergence() -> None:
    """In expectation over the model's own samples, which here are all tokens, weighted by their probability."""
    reference = jax.nn.log_softmax(jnp.asarray(SECOND[0, 0]))

    def exact(logits: jax.Array) -> jax.Array:
        return categorical_divergence(logits, reference)

    def sampled(logits: jax.Array) -> jax.Array:
        log_probs = jax.nn.log_softmax(logits)
        return jnp.sum(jax.lax.stop_gradient(jnp.exp(log_probs)) * k2(log_probs, reference))

    logits = jnp.asarray(FIRST[0, 0])
    np.testing.assert_allclose(jax.grad(sampled)(logits), jax.grad(exact)(logits), atol=1e-6)


def test_the_mean_is_over_all_tokens_that_count() -> None:
    values, weights = RNG.normal(size=(3, 5)), (RNG.random((3, 5)) < 0.5).astype(np.float32)
    wanted = sum(values[i, j] * weights[i, j] for i in range(3) for j in range(5)) / weights.sum()
    assert abs(float(weighted_text_mean(jnp.asarray(values, jnp.float32), jnp.asarray(weights))) - wanted) < 1e-6
    assert float(weighted_text_mean(jnp.ones((2, 2)), jnp.zeros((2, 2)))) == 0.0
