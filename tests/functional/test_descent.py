import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from thorndike.functional.descent import averaged, clipped_adamw, descend, descend_averaged, every, follow, optimized


def test_a_step_is_adams_and_the_norm_is_the_gradients():
    params, gradient = jnp.array([1.0, -2.0, 3.0]), jnp.array([3.0, 0.0, 4.0])
    reference = optax.adam(0.1)
    change, _ = reference.update(gradient, reference.init(params))
    held = optimized(params, optax.scale_by_adam())
    after, norm = descend(optax.scale_by_adam(), 0.1, held, gradient)
    np.testing.assert_allclose(after.params, params + change, rtol=1e-6)
    assert norm == 5.0


def test_a_target_follows_by_tau():
    np.testing.assert_allclose(follow(jnp.array([0.0, 1.0]), jnp.array([1.0, 1.0]), 0.25), [0.25, 1.0])


def test_an_update_that_comes_once_in_three_calls_reports_three_times_its_metrics():
    def update(held):
        return held + 1.0, {"loss": jnp.asarray(2.0)}

    held, reported = jnp.zeros(()), []
    for number in range(9):
        held, metrics = jax.jit(lambda n, held: every(3, n, update, held))(jnp.int32(number), held)
        reported.append(float(metrics["loss"]))
    assert held == 3.0
    assert reported == [0.0, 0.0, 6.0] * 3
    assert np.mean(reported) == 2.0
    assert every(1, jnp.int32(0), update, jnp.zeros(()))[0] == 1.0


def test_a_step_and_its_average_are_those_of_a_loop_and_a_step_that_is_no_number_is_not_taken():
    """AdamW with the global norm clipped, twice, over two leaves."""
    start = {"a": np.array([1.0, -2.0]), "b": np.array([[0.5]])}
    gradients = [{"a": np.array([3.0, 0.2]), "b": np.array([[-4.0]])}, {"a": np.array([0.1, -0.3]), "b": np.array([[0.2]])}]
    optimizer, rate, averaging, decay = clipped_adamw(2.0, 0.1), 0.05, 0.3, 0.1
    held = averaged(jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), start), optimizer)
    params, average = ({name: value.copy() for name, value in start.items()} for _ in range(2))
    first, second = ({name: np.zeros_like(value) for name, value in start.items()} for _ in range(2))
    for step, gradient in enumerate(gradients, start=1):
        norm = np.sqrt(sum((value**2).sum() for value in gradient.values()))
        held, told = descend_averaged(
            optimizer, rate, averaging, held, jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), gradient), jnp.zeros(())
        )
        assert float(told) == pytest.approx(norm, rel=1e-5)
        for name in start:
            clipped = gradient[name] * min(1.0, 2.0 / norm)
            first[name] = 0.9 * first[name] + 0.1 * clipped
            second[name] = 0.999 * second[name] + 0.001 * clipped**2
            adam = first[name] / (1 - 0.9**step) / (np.sqrt(second[name] / (1 - 0.999**step)) + 1e-8)
            params[name] = params[name] - rate * (adam + decay * params[name])
            average[name] = average[name] + averaging * (params[name] - average[name])
    for name in start:
        np.testing.assert_allclose(held.params[name], params[name], rtol=1e-4)
        np.testing.assert_allclose(held.average[name], average[name], rtol=1e-4)
    kept, _ = descend_averaged(optimizer, rate, averaging, held, held.params, jnp.full((), jnp.nan))
    assert all((a == b).all() for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(held), strict=True))
