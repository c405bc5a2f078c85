"""Distributions of actions against scipy, sums over all actions, and the frequencies of samples."""

import itertools

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from thorndike.errors import UserError
from thorndike.functional.action_distributions import action_distribution, categorical, diagonal_gaussian, multi_categorical

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
LOGITS = jnp.array([[0.5, -1.0, 2.0, 0.0], [3.0, 3.0, -2.0, 1.0]])


def softmax(logits: jax.Array) -> np.ndarray:
    wide = np.asarray(logits, np.float64)
    weight = np.exp(wide - wide.max(-1, keepdims=True))
    return weight / weight.sum(-1, keepdims=True)


def samples(distribution, parameters: jax.Array, count: int, seed: int = 0) -> np.ndarray:
    noise = distribution.draw(jax.random.key(seed), (count,))
    return np.asarray(distribution.sample(jnp.broadcast_to(parameters, (count, *parameters.shape)), noise))


@COMPILED
def test_a_categoricals_log_probabilities_and_entropy_are_those_of_its_softmax(compiled):
    distribution, probabilities = categorical(4), softmax(LOGITS)
    log_prob, entropy = (jax.jit(f) if compiled else f for f in (distribution.log_prob, distribution.entropy))
    for action in range(4):
        np.testing.assert_allclose(log_prob(LOGITS, jnp.full(2, action)), np.log(probabilities[:, action]), rtol=1e-5)
    np.testing.assert_allclose(entropy(LOGITS), [stats.entropy(row) for row in probabilities], rtol=1e-5)


def test_a_categoricals_samples_are_as_frequent_as_they_are_probable():
    distribution, count = categorical(4), 20_000
    action = samples(distribution, LOGITS[0], count)
    assert action.dtype == np.int32
    observed = np.bincount(action, minlength=4)
    assert stats.chisquare(observed, softmax(LOGITS[0]) * count).pvalue > 1e-3
    np.testing.assert_array_equal(distribution.mode(LOGITS), LOGITS.argmax(-1))


def test_extreme_logits_stay_finite():
    distribution, logits = categorical(3), jnp.array([[1e4, 0.0, -1e4]])
    assert np.isfinite(distribution.entropy(logits)).all()
    gradient = jax.grad(lambda x: distribution.log_prob(x, jnp.array([2])).sum() + distribution.entropy(x).sum())(logits)
    assert np.isfinite(gradient).all()


@COMPILED
def test_several_categoricals_are_independent(compiled):
    distribution, sizes = multi_categorical((2, 3, 1)), (2, 3, 1)
    logits = jax.random.normal(jax.random.key(0), (5, 6))
    parts = [softmax(part) for part in jnp.split(logits, [2, 5], axis=-1)]
    log_prob, entropy = (jax.jit(f) if compiled else f for f in (distribution.log_prob, distribution.entropy))
    total = np.zeros(5)
    for choice in itertools.product(*map(range, sizes)):
        expected = np.prod([part[:, i] for part, i in zip(parts, choice, strict=True)], axis=0)
        found = np.exp(log_prob(logits, jnp.tile(jnp.array(choice), (5, 1))))
        np.testing.assert_allclose(found, expected, rtol=1e-5)
        total += found
    np.testing.assert_allclose(total, 1, rtol=1e-5)
    np.testing.assert_allclose(entropy(logits), sum(stats.entropy(part, axis=-1) for part in parts), rtol=1e-5)


def test_samples_of_several_categoricals_follow_their_joint_probabilities():
    distribution, count = multi_categorical((2, 3)), 20_000
    logits = jnp.array([0.3, -0.4, 1.0, 0.0, -1.0])
    action = samples(distribution, logits, count)
    assert action.shape == (count, 2)
    observed = np.bincount(action[:, 0] * 3 + action[:, 1], minlength=6)
    joint = np.outer(softmax(logits[:2]), softmax(logits[2:])).ravel()
    assert stats.chisquare(observed, joint * count).pvalue > 1e-3
    np.testing.assert_array_equal(distribution.mode(logits[None]), [[0, 0]])


@COMPILED
def test_a_gaussians_density_and_entropy_are_scipys(compiled):
    distribution = diagonal_gaussian(3)
    mean, log_std, action = jax.random.normal(jax.random.key(1), (3, 7, 3))
    parameters = jnp.concatenate([mean, log_std], -1)
    reference = stats.norm(np.asarray(mean, float), np.exp(np.asarray(log_std, float)))
    log_prob, entropy = (jax.jit(f) if compiled else f for f in (distribution.log_prob, distribution.entropy))
    np.testing.assert_allclose(log_prob(parameters, action), reference.logpdf(action).sum(-1), rtol=1e-4)
    np.testing.assert_allclose(entropy(parameters), reference.entropy().sum(-1), rtol=1e-5)
    np.testing.assert_array_equal(distribution.mode(parameters), mean)


def test_a_gaussians_samples_have_its_mean_and_deviation():
    parameters = jnp.array([2.0, -1.0, jnp.log(0.5), jnp.log(3.0)])
    action = samples(diagonal_gaussian(2), parameters, 20_000)
    for column, mean, deviation in zip(action.T, (2, -1), (0.5, 3), strict=True):
        assert stats.kstest(column, stats.norm(mean, deviation).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("space", "outputs", "free", "shape"),
    [
        (spaces.Discrete(5), 5, 0, ()),
        (spaces.MultiDiscrete([2, 4]), 6, 0, (2,)),
        (spaces.Box(-1, 1, (3,)), 3, 3, (3,)),
    ],
)
def test_each_space_has_its_distribution(space, outputs, free, shape):
    distribution = action_distribution(space)
    assert (distribution.network_outputs, distribution.free_parameters) == (outputs, free)
    parameters, noise = jnp.zeros((4, outputs + free)), distribution.draw(jax.random.key(0), (4,))
    action = distribution.sample(parameters, noise)
    assert action.shape == (4, *shape) == distribution.mode(parameters).shape
    assert distribution.log_prob(parameters, action).shape == (4,) == distribution.entropy(parameters).shape


@pytest.mark.parametrize(
    "space",
    [spaces.Box(0, 255, (3,), np.uint8), spaces.Box(-1, 1, (2, 2)), spaces.MultiBinary((3, 2)), spaces.Dict({"a": spaces.Discrete(2)})],
)
def test_a_space_without_a_distribution_is_refused_in_one_line(space):
    with pytest.raises(UserError, match="actions may be Discrete, MultiDiscrete") as error:
        action_distribution(space)
    assert "\n" not in str(error.value)


SHARP = jnp.array([[0.3, -1.2, 0.4, -0.7], [2.0, 0.0, -1.5, 1.0]])
"""Two rows of two means and two log deviations, or of the logits of two modes and their log concentrations."""


def box_reference(kind: str, row: int, column: int):
    """Density and distribution function of one number of an action, by scipy."""
    first, second = (float(SHARP[row, i]) for i in (column, 2 + column))
    if kind == "beta":
        share, concentration = 1 / (1 + np.exp(-first)), np.exp(second)
        reference = stats.beta(1 + concentration * share, 1 + concentration * (1 - share), loc=-1, scale=2)
        return reference.pdf, reference.cdf
    inner = stats.norm(first, np.exp(second))
    return lambda x: inner.pdf(np.arctanh(x)) / (1 - x**2), lambda x: inner.cdf(np.arctanh(np.clip(x, -1 + 1e-9, 1 - 1e-9)))


@COMPILED
@pytest.mark.parametrize("kind", ["squashed", "beta"])
def test_a_bounded_distributions_density_and_entropy_are_those_of_integration(kind, compiled):
    distribution = action_distribution(spaces.Box(-1, 1, (2,)), kind)
    log_prob, entropy = (jax.jit(f) if compiled else f for f in (distribution.log_prob, distribution.entropy))
    pairs = np.array(list(itertools.product(np.linspace(-0.999, 0.999, 7), repeat=2)))
    for row in range(2):
        densities = [box_reference(kind, row, column)[0] for column in range(2)]
        expected = np.log(densities[0](pairs[:, 0])) + np.log(densities[1](pairs[:, 1]))
        found = log_prob(jnp.broadcast_to(SHARP[row], (len(pairs), 4)), jnp.asarray(pairs, jnp.float32))
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
        parts = [integrate.quad(lambda x, p=p: -p(x) * np.log(max(p(x), 1e-300)), -1, 1, limit=200)[0] for p in densities]
        np.testing.assert_allclose(entropy(SHARP)[row], sum(parts), atol=5e-3)


@pytest.mark.parametrize("kind", ["squashed", "beta"])
def test_a_bounded_distributions_samples_follow_its_density_and_never_leave_the_bounds(kind):
    distribution = action_distribution(spaces.Box(-1, 1, (2,)), kind)
    for row in range(2):
        action = samples(distribution, SHARP[row], 10_000, seed=row)
        assert np.abs(action).max() <= 1.0
        for column in range(2):
            assert stats.kstest(action[:, column].astype(float), box_reference(kind, row, column)[1]).statistic < 0.02


@pytest.mark.parametrize("kind", ["squashed", "beta"])
def test_gradients_at_the_bounds_and_far_parameters_are_finite(kind):
    distribution = action_distribution(spaces.Box(-1, 1, (2,)), kind)
    for scale in (0.0, 1.0, 30.0):
        parameters = scale * jnp.array([1.0, -1.0, -0.1, 0.1])
        for action in (jnp.array([1.0, -1.0]), distribution.mode(parameters)):
            slopes = jax.grad(lambda p, action=action: distribution.log_prob(p, action) + distribution.entropy(p))(parameters)
            assert np.isfinite(slopes).all(), (scale, action)


def test_a_betas_mode_is_where_its_density_is_highest():
    distribution, grid = action_distribution(spaces.Box(-1, 1, (2,)), "beta"), np.linspace(-0.999, 0.999, 2001)
    for row, column in itertools.product(range(2), range(2)):
        highest = grid[np.argmax(box_reference("beta", row, column)[0](grid))]
        np.testing.assert_allclose(distribution.mode(SHARP[row])[column], highest, atol=2e-3)


@pytest.mark.parametrize(
    ("space", "kind", "features", "said"),
    [
        (spaces.Discrete(2), "beta", 0, "action_distribution=beta is for Box actions"),
        (spaces.Discrete(2), "gaussian", 8, "use_sde is for Box actions"),
        (spaces.Box(-1, 1, (2,)), "beta", 8, "use_sde explores with Gaussian noise"),
    ],
)
def test_a_kind_that_a_space_cannot_have_is_refused_in_one_line(space, kind, features, said):
    with pytest.raises(UserError, match=said) as error:
        action_distribution(space, kind, features)
    assert "\n" not in str(error.value)
