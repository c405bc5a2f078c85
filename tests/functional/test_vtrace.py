"""V-trace against the paper's sum, term by term, with terminations, time limits and dead rows told apart."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.returns import generalized_advantage
from thorndike.functional.vtrace import vtrace

GAMMA, LAMBDA = 0.93, 0.9


def random_rows(length: int, batch: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(length)
    log_ratio, reward, value, next_value = rng.normal(size=(4, length, batch)).astype(np.float32)
    terminated, truncated = rng.random((2, length, batch)) < 0.15
    valid = rng.random((length, batch)) < 0.9
    numbers = {"log_ratio": log_ratio, "reward": reward, "value": value, "next_value": next_value}
    # Inside an episode the next row's value is that of the successor.
    inside = ~(terminated | truncated | ~valid)[:-1] & valid[1:]
    next_value[:-1] = np.where(inside, value[1:], next_value[:-1])
    return numbers | {"terminated": terminated, "truncated": truncated, "valid": valid}


def loop_vtrace(log_ratio, reward, value, next_value, terminated, truncated, valid, clip_rho, clip_c, clip_pg_rho):
    """Eq. 1 as it stands: ``v_s = V + sum_t gamma^(t-s) (prod c_i) rho_t delta_t``, and the advantage by the v of the row after."""
    length, batch = reward.shape
    target, advantage = value.astype(np.float64), np.zeros((length, batch))
    ratio = np.exp(log_ratio.astype(np.float64))
    for b in range(batch):
        for s in range(length):
            weight = 1.0
            for t in range(s, length):
                if not valid[t, b]:
                    break
                after = 0.0 if terminated[t, b] else next_value[t, b]
                target[s, b] += weight * min(clip_rho, ratio[t, b]) * (reward[t, b] + GAMMA * after - value[t, b])
                if terminated[t, b] or truncated[t, b]:
                    break
                weight *= GAMMA * LAMBDA * min(clip_c, ratio[t, b])
        for s in range(length):
            if not valid[s, b]:
                continue
            after = next_value[s, b]
            if s + 1 < length and valid[s + 1, b] and not truncated[s, b]:
                after = target[s + 1, b]
            after = 0.0 if terminated[s, b] else after
            advantage[s, b] = min(clip_pg_rho, ratio[s, b]) * (reward[s, b] + GAMMA * after - value[s, b])
    return target, advantage


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
@pytest.mark.parametrize(("length", "batch"), [(1, 1), (13, 4)])
@pytest.mark.parametrize("clips", [(1.0, 1.0, 1.0), (1.4, 0.7, 2.0), (np.inf, np.inf, np.inf)])
def test_targets_and_advantages_are_the_papers(length, batch, clips, compiled):
    rows = random_rows(length, batch)
    names = dict(zip(("clip_rho", "clip_c", "clip_pg_rho"), clips, strict=True))
    function = partial(vtrace, gamma=GAMMA, trace_decay=LAMBDA, **names)
    found = (jax.jit(function) if compiled else function)(**jax.tree.map(jnp.asarray, rows))
    target, advantage = loop_vtrace(**rows, **names)
    np.testing.assert_allclose(found.target, target, rtol=2e-4, atol=1e-4)
    np.testing.assert_allclose(found.advantage, advantage, rtol=2e-4, atol=1e-4)
    assert found.target.dtype == found.advantage.dtype == np.float32


def test_on_policy_it_is_the_lambda_return():
    rows = random_rows(20, 3)
    rows["log_ratio"] = np.zeros_like(rows["log_ratio"])
    rows["valid"] = np.ones_like(rows["valid"])
    rows = jax.tree.map(jnp.asarray, rows)
    found = vtrace(**rows, gamma=GAMMA, trace_decay=LAMBDA, clip_rho=1.0, clip_c=1.0, clip_pg_rho=1.0)
    done = rows["terminated"] | rows["truncated"]
    advantage = generalized_advantage(rows["reward"], rows["value"], rows["next_value"], rows["terminated"], done, GAMMA, LAMBDA)
    np.testing.assert_allclose(found.target, rows["value"] + advantage, rtol=1e-4, atol=1e-5)


def test_no_gradient_passes():
    rows = jax.tree.map(jnp.asarray, random_rows(5, 2))
    clips = {"clip_rho": 1.0, "clip_c": 1.0, "clip_pg_rho": 1.0}

    def total(value):
        found = vtrace(**(rows | {"value": value}), gamma=GAMMA, trace_decay=LAMBDA, **clips)
        return jnp.sum(found.target + found.advantage)

    assert not jax.grad(total)(rows["value"]).any()
