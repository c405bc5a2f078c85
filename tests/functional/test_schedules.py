"""Rates over a run: their values at the start, on the way and at the end, and what is refused."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.functional.schedules import schedule

COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])


def cosine(share: float) -> float:
    return 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * share))


@COMPILED
@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (3e-4, lambda p: 3e-4),
        ("3e-4", lambda p: 3e-4),
        ("linear(1.0, 0.1)", lambda p: 1 - 0.9 * min(p, 1)),
        (" linear(1.0,0.1,0.25) ", lambda p: 1 - 0.9 * min(p / 0.25, 1)),
        ("lin_2e-3", lambda p: 2e-3 * (1 - min(p, 1))),
        ("cosine(1, 0.1)", lambda p: cosine(min(p, 1))),
        ("cosine(1, 0.1, 0.5)", lambda p: cosine(min(2 * p, 1))),
        ("exponential(1, 0.01, 0.5)", lambda p: 0.01 ** min(2 * p, 1)),
        ("linear(0, 1)", lambda p: min(p, 1)),
    ],
)
def test_a_rate_follows_its_formula_and_stays_at_its_end(text, expected, compiled):
    rate = jax.jit(schedule(text)) if compiled else schedule(text)
    for progress in (0.0, 0.1, 0.25, 0.5, 0.8, 1.0, 1.5):
        found = rate(jnp.float32(progress))
        np.testing.assert_allclose(found, expected(progress), rtol=1e-5, atol=1e-7)
        assert found.dtype == jnp.float32


def test_a_constant_is_strongly_typed():
    assert not schedule(0.5)(jnp.float32(0)).weak_type


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fast", "a rate is a number or a schedule"),
        ("linear(1, 2", "a rate is a number or a schedule"),
        ("linear(1)", "two or three numbers"),
        ("linear(1, 2, 3, 4)", "two or three numbers"),
        ("linear(one, two)", "two or three numbers"),
        ("linear(1, 0, 0)", r"fraction of the run is in \(0, 1\]"),
        ("linear(1, 0, 2)", r"fraction of the run is in \(0, 1\]"),
        ("exponential(1, 0)", "positive ends"),
    ],
)
def test_other_text_is_refused_in_one_line(text, words):
    with pytest.raises(UserError, match=words) as error:
        schedule(text)
    assert "\n" not in str(error.value)
