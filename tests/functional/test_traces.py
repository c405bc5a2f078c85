import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.traces import Place, watkins

SEEDS, STATES, ACTIONS, ENVS = 2, 4, 3, 5


@pytest.mark.parametrize("compiled", [False, True])
def test_traces_and_values_equal_the_loop(compiled):
    """Tables of two seeds, one below the other; only the seed's own rows and the environment's own trace change."""
    rng = np.random.default_rng(0)
    q = rng.normal(size=(SEEDS * STATES, ACTIONS)).astype(np.float32)
    traces = np.zeros((ENVS, STATES, ACTIONS), np.float32)
    step = jax.jit(watkins) if compiled else watkins
    own_q, own_traces = jnp.asarray(q), jnp.asarray(traces)
    for _ in range(30):
        seed, env, state, action = (int(rng.integers(n)) for n in (SEEDS, ENVS, STATES, ACTIONS))
        change, fading, kept = float(rng.normal()), float(rng.choice([0.0, 0.8])), float(rng.choice([0.0, 1.0, 1.0]))
        place = Place(*(jnp.int32(number) for number in (seed * STATES, env, state, action)))
        own_q, own_traces = step(own_q, own_traces, place, jnp.float32(change), jnp.float32(fading), jnp.float32(kept))
        for s in range(STATES):
            for a in range(ACTIONS):
                traces[env, s, a] = 1.0 if (s, a) == (state, action) else fading * traces[env, s, a]
                q[seed * STATES + s, a] += change * traces[env, s, a]
                traces[env, s, a] *= kept
    np.testing.assert_allclose(own_q, q, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(own_traces, traces, rtol=1e-5, atol=1e-6)
