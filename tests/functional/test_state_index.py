import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiDiscrete, Tuple

from thorndike.errors import UserError
from thorndike.functional.state_index import state_index


def test_discrete_counts_from_its_start():
    states, number = state_index(Discrete(3, start=5))
    assert states == 3
    np.testing.assert_array_equal(number(jnp.array([5, 7], jnp.int32)), [0, 2])


def test_multi_discrete_numbers_every_element_once_last_component_fastest():
    states, number = state_index(MultiDiscrete([2, 3]))
    elements = np.array([[a, b] for a in range(2) for b in range(3)], np.int32)
    assert states == 6
    np.testing.assert_array_equal(number(jnp.asarray(elements)), range(6))


def test_a_tuple_of_blackjack_is_numbered_like_its_table():
    states, number = state_index(Tuple((Discrete(32), Discrete(11), Discrete(2))))
    obs = tuple(jnp.array([value], jnp.int32) for value in (20, 10, 1))
    assert states == 704
    np.testing.assert_array_equal(number(obs), [(20 * 11 + 10) * 2 + 1])


def test_continuous_observations_are_refused_with_the_way_out():
    with pytest.raises(UserError, match="discretise"):
        state_index(Box(-1.0, 1.0, (2,)))
