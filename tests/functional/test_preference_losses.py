"""Losses of preferences against slow loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.preference_losses import (
    bradley_terry_loss,
    centring_penalty,
    choice_loss,
    dpo_loss,
    plackett_luce_loss,
    ranked_pairs,
)

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
RNG = np.random.default_rng(3)
FIRST, SECOND = RNG.normal(size=(2, 40)).astype(np.float32)
P, WEIGHT = RNG.random(40).astype(np.float32), RNG.choice([0.0, 0.5, 1.0], 40).astype(np.float32)


def log_sigmoid(x: float) -> float:
    return -np.log1p(np.exp(-x))


def mean(terms: list[float], weight: np.ndarray) -> float:
    return sum(w * t for w, t in zip(weight, terms, strict=True)) / weight.sum()


@COMPILED
def test_bradley_terry_is_the_cross_entropy_with_soft_labels_and_weights(compiled):
    terms = [-(p * log_sigmoid(a - b) + (1 - p) * log_sigmoid(b - a)) for a, b, p in zip(FIRST, SECOND, P, strict=True)]
    function = jax.jit(bradley_terry_loss) if compiled else bradley_terry_loss
    np.testing.assert_allclose(function(*map(jnp.asarray, (FIRST, SECOND, P, WEIGHT))), mean(terms, WEIGHT), rtol=1e-5)


def test_bradley_terry_stays_finite_far_out():
    far = jnp.array([500.0, -500.0])
    gradient = jax.grad(lambda x: bradley_terry_loss(x, jnp.zeros(2), jnp.ones(2), jnp.ones(2)))(far)
    np.testing.assert_allclose(gradient, [0.0, -0.5], atol=1e-6)


@COMPILED
@pytest.mark.parametrize("error", [0.0, 0.1, 0.4])
def test_a_choice_is_bradley_terry_on_sums_but_for_errors_at_random(error, compiled):
    steps_first, steps_second = RNG.normal(size=(2, 40, 5)).astype(np.float32)
    terms = []
    for a, b, p in zip(steps_first, steps_second, P, strict=True):
        chance = (1 - error) / (1 + np.exp(sum(map(float, b)) - sum(map(float, a)))) + error / 2
        terms.append(-(p * np.log(chance) + (1 - p) * np.log(1 - chance)))
    function = jax.jit(choice_loss) if compiled else choice_loss
    found = function(*map(jnp.asarray, (steps_first.sum(1), steps_second.sum(1), P, WEIGHT)), error)
    np.testing.assert_allclose(found, mean(terms, WEIGHT), rtol=1e-4)


@pytest.mark.parametrize("error", [0.0, 0.1])
def test_a_choice_stays_finite_far_out(error):
    gradient = jax.grad(lambda x: choice_loss(x, jnp.zeros(2), jnp.ones(2), jnp.ones(2), error))(jnp.array([500.0, -500.0]))
    # Where errors are possible, what cannot be else is one and teaches nothing.
    np.testing.assert_allclose(gradient, [0.0, 0.0 if error else -0.5], atol=1e-6)


def test_centring_is_of_the_sum_of_both_rewards():
    wanted = mean([(a + b) ** 2 for a, b in zip(FIRST, SECOND, strict=True)], WEIGHT)
    np.testing.assert_allclose(centring_penalty(*map(jnp.asarray, (FIRST, SECOND, WEIGHT))), wanted, rtol=1e-5)


@COMPILED
def test_plackett_luce_is_a_choice_among_those_that_remain(compiled):
    scores, lengths, weight = RNG.normal(size=(6, 5)).astype(np.float32), [5, 4, 3, 2, 5, 2], np.array([1, 1, 0, 2, 1, 1], np.float32)
    terms = []
    for row, length in zip(scores.astype(np.float64), lengths, strict=True):
        terms.append(-sum(row[k] - np.log(np.exp(row[k:length]).sum()) for k in range(length)))
    valid = jnp.arange(5)[None] < jnp.array(lengths)[:, None]
    function = jax.jit(plackett_luce_loss) if compiled else plackett_luce_loss
    np.testing.assert_allclose(function(jnp.asarray(scores), valid, jnp.asarray(weight)), mean(terms, weight), rtol=1e-5)
    gradient = jax.grad(plackett_luce_loss)(jnp.asarray(scores), valid, jnp.asarray(weight))
    assert np.isfinite(gradient).all() and not np.asarray(gradient)[~np.asarray(valid)].any()


def test_plackett_luce_of_two_is_bradley_terry():
    scores = jnp.stack([jnp.asarray(FIRST), jnp.asarray(SECOND)], axis=1)
    ones = jnp.ones(40)
    wanted = bradley_terry_loss(scores[:, 0], scores[:, 1], ones, ones)
    np.testing.assert_allclose(plackett_luce_loss(scores, jnp.ones((40, 2), bool), ones), wanted, rtol=1e-5)


def test_all_pairs_of_a_ranking_count_as_one():
    valid = np.arange(4)[None] < np.array([4, 3, 2])[:, None]
    better, worse, weight = ranked_pairs(jnp.asarray(valid))
    assert [(int(i), int(j)) for i, j in zip(better, worse, strict=True)] == [(i, j) for i in range(4) for j in range(i + 1, 4)]
    for row, length in enumerate((4, 3, 2)):
        pairs = length * (length - 1) // 2
        wanted = [1 / pairs if j < length else 0.0 for i in range(4) for j in range(i + 1, 4)]
        np.testing.assert_allclose(weight[row], wanted, rtol=1e-6)


@COMPILED
@pytest.mark.parametrize(("kind", "smoothing"), [("sigmoid", 0.0), ("sigmoid", 0.1), ("robust", 0.1), ("ipo", 0.0)])
def test_dpo_losses(kind, smoothing, compiled):
    beta, terms = 0.3, []
    for margin in FIRST.astype(np.float64) * 5:
        right, wrong = -log_sigmoid(beta * margin), -log_sigmoid(-beta * margin)
        terms.append(
            {
                "sigmoid": (1 - smoothing) * right + smoothing * wrong,
                "robust": ((1 - smoothing) * right - smoothing * wrong) / (1 - 2 * smoothing),
                "ipo": (margin - 1 / (2 * beta)) ** 2,
            }[kind]
        )
    function = jax.jit(dpo_loss, static_argnames="kind") if compiled else dpo_loss
    found = function(jnp.asarray(FIRST) * 5, jnp.asarray(WEIGHT), beta, kind=kind, label_smoothing=smoothing)
    np.testing.assert_allclose(found, mean(terms, WEIGHT), rtol=1e-5)


def test_robust_dpo_is_right_on_average_over_flipped_labels():
    margin, one, flips = jnp.array([1.3]), jnp.ones(1), 0.2
    clean = dpo_loss(margin, one, 0.5)
    noisy = (1 - flips) * dpo_loss(margin, one, 0.5, "robust", flips) + flips * dpo_loss(-margin, one, 0.5, "robust", flips)
    np.testing.assert_allclose(noisy, clean, rtol=1e-5)
