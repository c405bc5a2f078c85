"""The conjugate gradient method against the loop of a textbook and a direct solution; the line search against a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.trust_region import backtracking_line_search, conjugate_gradient

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])


def positive_definite(n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    root = rng.normal(size=(n, n))
    return (root @ root.T / n + np.eye(n)).astype(np.float32), rng.normal(size=n).astype(np.float32)


def loop_conjugate_gradient(matrix, right, steps):
    x, residual = np.zeros(len(right)), right.astype(np.float64)
    search = residual.copy()
    for _ in range(steps):
        rate = residual @ residual / (search @ matrix @ search)
        x = x + rate * search
        after = residual - rate * (matrix @ search)
        search = after + (after @ after) / (residual @ residual) * search
        residual = after
    return x


@COMPILED
@pytest.mark.parametrize("steps", [1, 3, 5])
def test_so_many_steps_of_conjugate_gradient(steps, compiled):
    matrix, right = positive_definite(8)
    solve = lambda b: conjugate_gradient(lambda p: jnp.asarray(matrix) @ p, b, steps)  # noqa: E731
    found = (jax.jit(solve) if compiled else solve)(jnp.asarray(right))
    np.testing.assert_allclose(found, loop_conjugate_gradient(matrix.astype(np.float64), right, steps), rtol=1e-3, atol=1e-4)


def test_enough_steps_solve_the_system_and_more_do_no_harm():
    matrix, right = positive_definite(8)
    found = conjugate_gradient(lambda p: jnp.asarray(matrix) @ p, jnp.asarray(right), 100)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-3, atol=1e-4)


def test_of_nothing_the_solution_is_nothing():
    found = conjugate_gradient(lambda p: 2.0 * p, jnp.zeros(3), 10)
    np.testing.assert_array_equal(found, np.zeros(3))


@COMPILED
@pytest.mark.parametrize(("limit", "tries"), [(2.0, 5), (1.0, 5), (0.5, 5), (0.1, 5), (0.01, 5), (0.9, 1)])
def test_the_largest_step_that_is_accepted(limit, tries, compiled):
    search = lambda most: backtracking_line_search(lambda fraction: fraction <= most, 0.6, tries)  # noqa: E731
    found = (jax.jit(search) if compiled else search)(jnp.float32(limit))
    fractions = [0.6**i for i in range(tries) if 0.6**i <= limit]
    assert bool(found.accepted) == bool(fractions)
    np.testing.assert_allclose(found.fraction, fractions[0] if fractions else 0.0, rtol=1e-6)
