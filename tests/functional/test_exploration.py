import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.exploration import boltzmann, epsilon_greedy, optimistic, upper_confidence


def slow_choice(q, epsilon, uniform, random_ties):
    """What the docstring says, one row at a time."""
    actions, greedy = [], []
    for row, u in zip(np.float32(q), np.float32(uniform), strict=True):
        best = [action for action in range(len(row)) if row[action] == max(row)]
        explores = u < np.float32(epsilon)
        candidates = list(range(len(row))) if explores else best
        low, width = (np.float32(0), np.float32(epsilon)) if explores else (np.float32(epsilon), np.float32(1 - np.float32(epsilon)))
        position = min(int(np.floor((u - low) / width * np.float32(len(candidates)))), len(candidates) - 1)
        actions.append(candidates[position if explores or random_ties else 0])
        greedy.append(actions[-1] in best)
    return actions, greedy


@pytest.mark.parametrize("random_ties", [True, False])
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_equals_the_loop(epsilon, random_ties):
    rng = np.random.default_rng(0)
    q = rng.integers(0, 3, (500, 4)).astype(np.float32)
    uniform = rng.random(500).astype(np.float32)
    actions, greedy = slow_choice(q, epsilon, uniform, random_ties)
    choice = jax.jit(lambda q, e, u: epsilon_greedy(q, e, u, random_ties=random_ties))(q, jnp.float32(epsilon), uniform)
    np.testing.assert_array_equal(choice.action, actions)
    np.testing.assert_array_equal(choice.greedy, greedy)


def frequencies(q_row, epsilon, random_ties=True):
    draws = 400_000
    uniform = jax.random.uniform(jax.random.key(5), (draws,))
    q = jnp.broadcast_to(jnp.array(q_row), (draws, len(q_row)))
    action = epsilon_greedy(q, jnp.float32(epsilon), uniform, random_ties=random_ties).action
    return np.bincount(np.asarray(action), minlength=len(q_row)) / draws


def test_exploring_spreads_evenly_and_the_rest_goes_to_the_best():
    np.testing.assert_allclose(frequencies([0.0, 1.0, 0.0, 0.0], 0.2), [0.05, 0.85, 0.05, 0.05], atol=3e-3)


def test_ties_are_broken_evenly():
    np.testing.assert_allclose(frequencies([1.0, 0.0, 1.0, 1.0], 0.0), [1 / 3, 0, 1 / 3, 1 / 3], atol=3e-3)


def test_without_random_ties_the_first_of_the_best_wins():
    np.testing.assert_allclose(frequencies([0.0, 1.0, 1.0, 0.0], 0.0, random_ties=False), [0, 1, 0, 0], atol=0)


def test_the_largest_and_smallest_draws_are_actions():
    q = jnp.zeros((2, 3))
    action = epsilon_greedy(q, jnp.float32(0.0), jnp.array([0.0, np.nextafter(np.float32(1), np.float32(0))])).action
    np.testing.assert_array_equal(action, [0, 2])


def test_boltzmann_equals_the_loop():
    rng = np.random.default_rng(2)
    q, uniform = rng.normal(size=(500, 4)).astype(np.float32), rng.random(500).astype(np.float32)
    q[::7, 3] = -1e9
    choice = jax.jit(boltzmann)(q, jnp.full((1,), 0.5), uniform)
    for row, u, action, greedy in zip(q, uniform, choice.action, choice.greedy, strict=True):
        odds = [np.exp((value - max(row)) / 0.5) for value in row]
        place, wanted = 0.0, u * sum(odds)
        expected = -1
        while wanted >= place:
            expected += 1
            place += odds[expected]
        assert action == expected or abs(wanted - place) < 1e-5 * sum(odds)
        assert greedy == (row[action] == max(row))
        assert row[action] > -1e8


def test_boltzmann_at_the_ends_of_its_range():
    last = np.nextafter(np.float32(1), np.float32(0))
    q = jnp.tile(jnp.array([-1e9, 0.0, 1.0, -1e9]), (2, 1))
    np.testing.assert_array_equal(boltzmann(q, jnp.ones(1), jnp.array([0.0, last])).action, [1, 2])
    np.testing.assert_array_equal(boltzmann(q, jnp.full((1,), 1e-6), jnp.array([0.0, last])).action, [2, 2])


def test_upper_confidence_equals_the_loop():
    rng = np.random.default_rng(3)
    q, visits = rng.normal(size=(200, 3)).astype(np.float32), rng.integers(0, 5, (200, 3)).astype(np.int32)
    values = jax.jit(lambda q, n: upper_confidence(q, n, 0.7))(q, visits)
    for row, counts, got in zip(q, visits, values, strict=True):
        total = max(sum(counts), 1)
        expected = [1e9 if n == 0 else value + 0.7 * np.sqrt(np.log(total) / n) for value, n in zip(row, counts, strict=True)]
        np.testing.assert_allclose(got, expected, rtol=1e-5)
    choice = optimistic(jnp.asarray(q), jnp.asarray(visits), 0.7, jnp.asarray(rng.random(200), jnp.float32))
    assert all(got[action] == max(got) for got, action in zip(values, choice.action, strict=True))
    np.testing.assert_array_equal(choice.greedy, [row[action] == max(row) for row, action in zip(q, choice.action, strict=True)])
