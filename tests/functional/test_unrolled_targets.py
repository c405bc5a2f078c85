"""What a learnt model is taught K steps ahead, against a loop over steps, with deaths and limits told apart."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.unrolled_targets import scaled_gradient, unrolled_targets

UNROLL, N_STEP, BATCH = 4, 3, 200


def loop_targets(reward, next_value, terminated, done, discount):
    """One sequence at a time, one step at a time."""
    value, known, alive = (np.zeros((UNROLL + 1, BATCH)) for _ in range(3))
    rewards = np.zeros((UNROLL, BATCH))
    for b in range(BATCH):
        state = "alive"
        for k in range(UNROLL + 1):
            known[k, b], alive[k, b] = state != "unseen", state == "alive"
            if state == "alive":
                factor = 1.0
                for t in range(k, k + N_STEP):
                    value[k, b] += factor * reward[t, b]
                    factor *= discount
                    if done[t, b]:
                        break
                if not terminated[t, b]:
                    value[k, b] += factor * next_value[t, b]
            if k < UNROLL and state == "alive":
                rewards[k, b] = reward[k, b]
                if done[k, b]:
                    state = "dead" if terminated[k, b] else "unseen"
    return value, rewards, known, alive


@pytest.mark.parametrize("discount", [0.9, -1.0, -0.8], ids=str)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_targets_are_those_of_a_loop(compiled: bool, discount: float):
    rng = np.random.default_rng(1)
    terminated, truncated = rng.random((2, UNROLL + N_STEP, BATCH)) < 0.12
    reward, next_value = rng.normal(size=(2, UNROLL + N_STEP, BATCH)).astype(np.float32)
    target = partial(unrolled_targets, discount=discount, n_step=N_STEP)
    found = (jax.jit(target) if compiled else target)(*map(jnp.asarray, (reward, next_value, terminated, terminated | truncated)))
    by_hand = loop_targets(reward, next_value, terminated, terminated | truncated, discount)
    for name, expected in zip(found._fields, by_hand, strict=True):
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-5, atol=1e-5, err_msg=name)
    assert {0.0, 1.0} == set(np.unique(found.known)) == set(np.unique(found.alive)) and (found.known != found.alive).any()


def test_a_scaled_gradient_leaves_the_numbers_and_halves_the_gradient():
    x = jnp.array([1.0, -2.0, 3.0])
    value, gradient = jax.value_and_grad(lambda x: jnp.sum(jnp.square(scaled_gradient(x, 0.5))))(x)
    assert float(value) == pytest.approx(14.0)
    np.testing.assert_allclose(gradient, x)
