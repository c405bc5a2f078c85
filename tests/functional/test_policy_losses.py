"""Losses and estimators of policy gradients against loops; gradients at the edges of the clip."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.policy_losses import (
    approximate_kl,
    clip_fraction,
    clipped_surrogate,
    explained_variance,
    standardize,
    value_loss,
    weighted_mean,
)

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
CLIP = 0.2


def rows(seed: int = 0, n: int = 50) -> tuple[jax.Array, ...]:
    """Log ratios, advantages, weights (some 0)."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n)).astype(np.float32)
    return jnp.asarray(0.4 * x), jnp.asarray(y), jnp.asarray(rng.random(n) < 0.7, jnp.float32)


def loop_mean(terms, weight) -> float:
    return float(sum(w * t for t, w in zip(terms, weight, strict=True)) / sum(weight))


@COMPILED
def test_the_surrogate_is_the_worse_of_the_ratio_and_the_clipped_ratio(compiled):
    log_ratio, advantage, weight = rows()
    terms = []
    for logs, a in zip(log_ratio.tolist(), advantage.tolist(), strict=True):
        ratio = np.exp(logs)
        clipped = min(max(ratio, 1 - CLIP), 1 + CLIP)
        terms.append(min(ratio * a, clipped * a))
    function = jax.jit(clipped_surrogate) if compiled else clipped_surrogate
    np.testing.assert_allclose(function(log_ratio, advantage, CLIP, weight), -loop_mean(terms, weight), rtol=1e-5)


@pytest.mark.parametrize(
    ("ratio", "advantage", "slope"),
    [
        (1.19, 1.0, 1.0),  # inside: the plain policy gradient
        (1.21, 1.0, 0.0),  # already more likely than the clip allows: no push further
        (1.21, -1.0, -1.0),  # gone the wrong way: the way back is never cut
        (0.81, -1.0, -1.0),
        (0.79, -1.0, 0.0),
        (0.79, 1.0, 1.0),
        (1.0, 1.0, 1.0),
        (50.0, -2.0, -2.0),
    ],
)
def test_gradients_vanish_only_beyond_the_edge_that_the_advantage_pushes_to(ratio, advantage, slope):
    def loss(value):
        return clipped_surrogate(jnp.log(value)[None], jnp.array([advantage]), CLIP, jnp.ones(1))

    gradient = jax.jit(jax.grad(loss))(jnp.float32(ratio))
    np.testing.assert_allclose(gradient, -slope, rtol=1e-5, atol=1e-6)


def test_rows_of_weight_zero_have_no_gradient():
    log_ratio, advantage, weight = rows(1)
    gradient = jax.grad(clipped_surrogate)(log_ratio, advantage, CLIP, weight)
    assert (gradient[weight == 0] == 0).all()
    assert (gradient[weight > 0] != 0).any()


@COMPILED
@pytest.mark.parametrize("clip", [None, 0.3])
def test_the_value_loss_is_the_larger_of_the_plain_and_the_clipped_error(clip, compiled):
    value, target, weight = rows(2)
    old = value + 0.5 * jnp.sin(20 * value)
    terms = []
    for v, o, t in zip(value.tolist(), old.tolist(), target.tolist(), strict=True):
        near = v if clip is None else o + min(max(v - o, -clip), clip)
        terms.append(max((v - t) ** 2, (near - t) ** 2))
    function = jax.jit(value_loss, static_argnums=3) if compiled else value_loss
    np.testing.assert_allclose(function(value, old, target, clip, weight), loop_mean(terms, weight), rtol=1e-5)


@COMPILED
def test_the_kl_estimate_is_r_minus_1_minus_log_r(compiled):
    log_ratio, _, weight = rows(4)
    terms = [np.exp(logs) - 1 - logs for logs in log_ratio.tolist()]
    function = jax.jit(approximate_kl) if compiled else approximate_kl
    np.testing.assert_allclose(function(log_ratio, weight), loop_mean(terms, weight), rtol=1e-4)


def test_the_kl_estimate_is_unbiased_and_never_negative():
    rng = np.random.default_rng(5)
    old, new = np.array([0.5, 0.3, 0.2]), np.array([0.3, 0.3, 0.4])
    action = rng.choice(3, 200_000, p=old)
    estimate = float(approximate_kl(jnp.asarray(np.log(new / old)[action], jnp.float32), jnp.ones(200_000)))
    assert estimate == pytest.approx(float(np.sum(old * np.log(old / new))), rel=0.03)
    tiny = jnp.full(10, 1e-4)
    assert 0 <= float(approximate_kl(tiny, jnp.ones(10))) < 1e-7


@COMPILED
def test_the_clip_fraction_counts_ratios_outside_the_range(compiled):
    log_ratio, _, weight = rows(6)
    terms = [float(abs(np.exp(logs) - 1) > CLIP) for logs in log_ratio.tolist()]
    function = jax.jit(clip_fraction) if compiled else clip_fraction
    found = function(log_ratio, CLIP, weight)
    np.testing.assert_allclose(found, loop_mean(terms, weight), rtol=1e-5)
    assert 0 < float(found) < 1


@COMPILED
def test_explained_variance_is_over_valid_rows_alone(compiled):
    prediction, target, weight = rows(7)
    valid = weight > 0
    expected = 1 - np.var(np.asarray(target - prediction)[valid]) / np.var(np.asarray(target)[valid])
    function = jax.jit(explained_variance) if compiled else explained_variance
    np.testing.assert_allclose(function(prediction, target, valid), expected, rtol=1e-4)


def test_explained_variance_is_1_if_perfect_and_0_for_the_mean():
    _, target, _ = rows(8)
    valid = jnp.ones_like(target, bool)
    assert float(explained_variance(target, target, valid)) == 1.0
    assert float(explained_variance(jnp.full_like(target, target.mean()), target, valid)) == pytest.approx(0.0, abs=1e-5)


@COMPILED
def test_standardised_rows_have_mean_0_and_variance_1_over_the_weighted_ones(compiled):
    x, _, weight = rows(9)
    function = jax.jit(standardize) if compiled else standardize
    found = np.asarray(function(5 + 3 * x, weight))
    kept = np.asarray(5 + 3 * x)[weight > 0]
    np.testing.assert_allclose(found[weight > 0], (kept - kept.mean()) / kept.std(), rtol=1e-3, atol=1e-4)


def test_equal_rows_are_standardised_to_zero():
    np.testing.assert_array_equal(standardize(jnp.full(4, 7.0), jnp.ones(4)), np.zeros(4))


@COMPILED
def test_a_weighted_mean_of_nothing_is_0(compiled):
    x, _, weight = rows(10)
    function = jax.jit(weighted_mean) if compiled else weighted_mean
    np.testing.assert_allclose(function(x, weight), loop_mean(x, weight), rtol=1e-5)
    assert float(function(x, jnp.zeros_like(weight))) == 0.0
