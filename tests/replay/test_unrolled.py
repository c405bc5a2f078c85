"""Sequences that a learnt model is taught by: what is drawn really happened, in that order, up to where an episode ends."""

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from thorndike.replay.uniform import add, drawn_rows, init_replay, row_shapes
from thorndike.replay.unrolled import unrolled_at
from thorndike.types import EnvSpec, Rollout, Step

STEPS, NUM_ENVS, UNROLL, N_STEP = 12, 3, 2, 3
SPEC = EnvSpec("numbers", spaces.Box(0, np.inf, (1,)), spaces.Discrete(100), NUM_ENVS)
FOUND = {"policy": jax.ShapeDtypeStruct((2,), jnp.float32), "value": jax.ShapeDtypeStruct((), jnp.float32)}


def happened(first: int, length: int, done: np.ndarray) -> Rollout:
    """Step ``t`` of environment ``b`` has the number ``100 t + b``; its successor is 0.5 more, its value a thousandth."""
    number = (100 * np.arange(first, first + length)[:, None] + np.arange(NUM_ENVS)).astype(np.float32)
    no, obs = np.zeros((length, NUM_ENVS), bool), jnp.asarray(number)[..., None]
    step = Step(obs + 100, obs + 0.5, jnp.asarray(number + 1), jnp.zeros_like(number), jnp.asarray(no), jnp.asarray(done), jnp.asarray(~no))
    policy = jnp.stack([jnp.asarray(number), jnp.asarray(-number)], axis=-1)
    search = {"policy": policy, "value": jnp.asarray(number) / 1000}
    return Rollout(obs, jnp.asarray(number % 100, jnp.int32), {"search": search}, step, ())


def test_sequences_hold_what_followed_and_stop_looking_where_an_episode_ends():
    ends = np.random.default_rng(0).random((20, NUM_ENVS)) < 0.25
    buffer = init_replay(row_shapes(SPEC, search=FOUND), STEPS, NUM_ENVS)
    for first in range(0, 20, 4):
        buffer = jax.jit(add)(buffer, happened(first, 4, ends[first : first + 4]))
    rows = drawn_rows(buffer, jax.random.key(0), 300, NUM_ENVS, UNROLL + N_STEP + 1)
    batch = jax.tree.map(np.asarray, unrolled_at(buffer, rows, NUM_ENVS, UNROLL, N_STEP, again=True))
    seen = set()
    for m, number in enumerate(batch.obs[:, 0].astype(int)):
        t, b = divmod(number, 100)
        seen.add(t)
        after = [100 * (t + i) + b for i in range(UNROLL + N_STEP + 1)]
        assert list(batch.reward[:, m]) == [n + 1 for n in after[:-1]]
        assert list(batch.action[:, m]) == [b] * UNROLL
        np.testing.assert_allclose(batch.value[:, m], [n / 1000 for n in after[1:]], rtol=1e-6)
        assert [list(row) for row in batch.policy[:, m]] == [[n, -n] for n in after[: UNROLL + 1]]
        assert list(batch.later_obs[:, m, 0]) == after[N_STEP:]
        done = [bool(ends[t + i, b]) for i in range(UNROLL + N_STEP)]
        assert list(batch.done[:, m]) == done
        end = done.index(True) if any(done) else UNROLL + N_STEP - 1
        assert batch.end_obs[m, 0] == after[end] + 0.5
    # Of the steps 8 to 19 that are stored, those after which enough is stored.
    assert seen == set(range(8, 15))
