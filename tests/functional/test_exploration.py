import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.exploration import epsilon_greedy


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
