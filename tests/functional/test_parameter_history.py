"""A ring of parameter sets against a list of all of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.parameter_history import new_history, newest, of_version, updated


@pytest.mark.parametrize("length", [1, 2, 4])
def test_the_set_of_a_version_is_the_one_that_was_put_there(length):
    every = [np.full(3, float(i), np.float32) for i in range(10)]
    history = new_history(jnp.asarray(every[0]), length)
    for version in range(10):
        if version:
            history = jax.jit(updated)(history, jnp.asarray(every[version]))
        assert int(history.version) == version
        np.testing.assert_array_equal(newest(history), every[version])
        for asked in range(-2, version + 1):
            kept = max(asked, version - length + 1, 0)
            np.testing.assert_array_equal(of_version(history, jnp.int32(asked)), every[kept])
