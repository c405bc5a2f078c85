import jax
import jax.numpy as jnp
import numpy as np
import optax

from thorndike.functional.descent import descend, every, follow, optimized


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
