"""Values squeezed and shared between atoms, against loops, and back again."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.value_transform import EPSILON, Scale, signed_root, signed_square

NUMBERS = np.concatenate([np.linspace(-400, 400, 41), [-1e-3, 0.0, 1e-3, 0.5, 3e4]]).astype(np.float32)


def root_by_hand(x: float) -> float:
    return math.copysign(math.sqrt(abs(x) + 1) - 1, x) + EPSILON * x


@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_the_root_is_that_of_a_loop_and_the_square_brings_back_what_went_in(compiled: bool):
    there, back = (jax.jit(f) if compiled else f for f in (signed_root, signed_square))
    squeezed = there(jnp.asarray(NUMBERS))
    np.testing.assert_allclose(squeezed, [root_by_hand(float(x)) for x in NUMBERS], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(back(squeezed), NUMBERS, rtol=1e-5, atol=1e-5)


def test_probabilities_are_those_of_the_two_neighbours_and_say_the_number_again():
    scale = Scale(300.0, 41)
    support = np.linspace(-root_by_hand(300.0), root_by_hand(300.0), 41)
    by_hand = np.zeros((len(NUMBERS), 41))
    for i, x in enumerate(NUMBERS):
        place = (np.clip(root_by_hand(float(x)), support[0], support[-1]) - support[0]) / (support[1] - support[0])
        below = min(int(place), 39)
        by_hand[i, below], by_hand[i, below + 1] = 1 - (place - below), place - below
    probabilities = jax.jit(scale.probabilities)(jnp.asarray(NUMBERS))
    np.testing.assert_allclose(probabilities, by_hand, atol=2e-5)
    again = scale.number(jnp.log(jnp.maximum(probabilities, 1e-30)))
    np.testing.assert_allclose(again, np.clip(NUMBERS, -300, 300), rtol=1e-4, atol=1e-3)


def test_logits_that_are_all_alike_say_nothing_at_all():
    assert float(Scale(7.0, 9).number(jnp.zeros(9))) == pytest.approx(0.0, abs=1e-6)
