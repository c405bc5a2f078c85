import jax
import numpy as np
import pytest

from thorndike.functional.coloured_noise import coloured_noise


@pytest.mark.parametrize("steps", [64, 63])
@pytest.mark.parametrize("color", [0.0, 1.0, 2.0])
def test_every_number_is_standard_normal(steps, color):
    noise = np.asarray(coloured_noise(jax.random.key(0), steps, (2000, 2), color))
    assert noise.shape == (steps, 2000, 2)
    assert abs(noise.mean()) < 0.05
    np.testing.assert_allclose(noise.var(axis=(1, 2)), 1.0, atol=0.12)
    np.testing.assert_allclose(noise.var(), 1.0, atol=0.03)


@pytest.mark.parametrize("color", [0.5, 1.0, 2.0])
def test_the_power_of_a_frequency_falls_with_the_colors_power_of_it(color):
    noise = np.asarray(coloured_noise(jax.random.key(1), 256, (2000,), color))
    power = np.mean(np.abs(np.fft.rfft(noise, axis=0)) ** 2, axis=1)
    slope = np.polyfit(np.log(np.arange(2, 100)), np.log(power[2:100]), 1)[0]
    assert abs(slope + color) < 0.05


def test_white_noise_and_a_single_step_are_the_normal_draw():
    key = jax.random.key(3)
    np.testing.assert_array_equal(coloured_noise(key, 8, (3,), 0.0), jax.random.normal(key, (8, 3)))
    np.testing.assert_array_equal(coloured_noise(key, 1, (3,), 1.0), jax.random.normal(key, (1, 3)))
