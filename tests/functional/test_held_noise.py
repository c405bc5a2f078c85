"""State-dependent exploration against slow loops: the density over all noise matrices, and how long one is held."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from thorndike.errors import UserError
from thorndike.functional.action_distributions import state_dependent_gaussian
from thorndike.functional.held_noise import (
    HeldNoise,
    noise_features,
    state_dependent_parameters,
    state_dependent_sample,
    with_constant,
    with_held_noise,
)
from thorndike.types import Algorithm, Needs, Rollout

ROWS, FEATURES, DIMENSIONS = 5, 4, 3
KEYS = jax.random.split(jax.random.key(0), 4)
MEAN, HIDDEN = jax.random.normal(KEYS[0], (ROWS, DIMENSIONS)), jnp.abs(jax.random.normal(KEYS[1], (ROWS, FEATURES)))
LOG_STD, NOISE = jax.random.normal(KEYS[2], (FEATURES, DIMENSIONS)), jax.random.normal(KEYS[3], (ROWS, FEATURES, DIMENSIONS))


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_parameters_and_samples_are_those_of_a_slow_loop(compiled):
    make, sample = (jax.jit(f) if compiled else f for f in (state_dependent_parameters, state_dependent_sample))
    parameters = make(MEAN, HIDDEN, LOG_STD)
    action = sample(parameters, NOISE)
    for b in range(ROWS):
        for d in range(DIMENSIONS):
            noise = variance = 0.0
            for h in range(FEATURES):
                deviation = float(np.exp(LOG_STD[h, d]))
                noise += float(HIDDEN[b, h]) * deviation * float(NOISE[b, h, d])
                variance += float(HIDDEN[b, h]) ** 2 * deviation**2
            np.testing.assert_allclose(action[b, d], MEAN[b, d] + noise, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(parameters[b, DIMENSIONS + d], 0.5 * np.log(variance + 1e-6), rtol=1e-4, atol=1e-5)


def test_the_density_is_that_of_actions_over_all_noise_matrices():
    distribution = state_dependent_gaussian(DIMENSIONS, FEATURES)
    parameters = state_dependent_parameters(MEAN, HIDDEN, LOG_STD)
    noise = distribution.draw(jax.random.key(5), (10_000,))
    action = np.asarray(distribution.sample(jnp.broadcast_to(parameters[0], (10_000, parameters.shape[1])), HeldNoise(noise, noise)))
    deviation = np.exp(np.asarray(parameters[0, DIMENSIONS : 2 * DIMENSIONS]))
    for d in range(DIMENSIONS):
        assert stats.kstest(action[:, d], stats.norm(MEAN[0, d], deviation[d]).cdf).pvalue > 1e-3
    expected = stats.norm(np.asarray(MEAN[0]), deviation)
    np.testing.assert_allclose(distribution.log_prob(parameters[0], MEAN[1]), expected.logpdf(MEAN[1]).sum(), rtol=1e-4)
    np.testing.assert_allclose(distribution.entropy(parameters[0]), expected.entropy().sum(), rtol=1e-4)
    np.testing.assert_array_equal(distribution.mode(parameters), MEAN)


def test_there_is_noise_where_all_features_are_zero():
    features = with_constant(jnp.zeros((2, 3)))
    assert features.shape == (2, noise_features(3))
    parameters = state_dependent_parameters(jnp.zeros((2, 1)), features, jnp.full((4, 1), -1.0))
    np.testing.assert_allclose(parameters[:, 1], -1.0, atol=1e-5)


def recording(length: int) -> Algorithm:
    """A learner whose action is its noise."""
    return Algorithm(
        init=lambda key: (),
        actor=lambda state: (),
        memory=lambda batch: jnp.zeros((batch,)),
        draw=lambda key, steps: jax.random.normal(key, (steps, 2, FEATURES, DIMENSIONS)),
        act=lambda actor, memory, obs, noise: (memory + 1, noise, {}),
        greedy=lambda actor, memory, obs, noise: (memory + 1, obs, {}),
        value=lambda actor, obs: obs,
        update=lambda state, rollout, key: (rollout.memory, {}),
        observe=lambda state, rollout, key: (rollout.memory, {}),
        needs=Needs(length, on_policy=True),
    )


@pytest.mark.parametrize(("freq", "every"), [(3, 3), (1, 1), (-1, 5)])
def test_noise_is_held_for_as_long_as_asked_and_begins_anew_with_an_episode(freq, every):
    algorithm = with_held_noise(recording(5), freq)
    noise, memory = algorithm.draw(jax.random.key(0), 12), algorithm.memory(2)
    expected, age = [None, None], [0, 0]
    for t in range(12):
        memory, action, _ = algorithm.act((), memory, jnp.zeros(2), noise[t])
        np.testing.assert_array_equal(action.fresh, noise[t])
        for b in range(2):
            expected[b] = noise[t, b] if age[b] % every == 0 else expected[b]
            np.testing.assert_array_equal(action.held[b], expected[b])
            age[b] += 1
        if t == 6:  # the second environment's episode ends
            fresh, age[1] = algorithm.memory(2), 0
            memory = jax.tree.map(lambda new, old: old.at[1].set(new[1]), fresh, memory)
    np.testing.assert_array_equal(memory.inner, [12, 5])


def test_learning_and_the_greedy_policy_see_the_learners_own_memory():
    algorithm = with_held_noise(recording(5), 2)
    memory = algorithm.memory(2)
    rollout = Rollout((), (), {}, (), memory)
    for way in (algorithm.update, algorithm.observe):
        np.testing.assert_array_equal(way((), rollout, jax.random.key(0))[0], memory.inner)
    later, _, _ = algorithm.greedy((), memory, jnp.zeros(2), ())
    np.testing.assert_array_equal(later.inner, [1, 1])


def test_no_steps_are_refused_in_one_line():
    with pytest.raises(UserError, match="sde_sample_freq is at least 1, or -1") as error:
        with_held_noise(recording(5), 0)
    assert "\n" not in str(error.value)
