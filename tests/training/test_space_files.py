"""Spaces as JSON and back."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from thorndike.errors import UserError
from thorndike.training.space_files import space_from_json, space_to_json

SPACES = [
    spaces.Discrete(5),
    spaces.Discrete(3, start=-2),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiDiscrete([2, 3], start=[1, -1]),
    spaces.MultiDiscrete([[2, 3], [4, 5]]),
    spaces.MultiBinary([4]),
    spaces.MultiBinary([2, 2]),
    spaces.Box(-1, 1, (3,)),
    spaces.Box(-np.inf, np.inf, (2,), np.float64),
    spaces.Box(np.array([-4.8, -np.inf], np.float32), np.array([4.8, 0.1], np.float32)),
    spaces.Box(0, 255, (84, 84, 4), np.uint8),
    spaces.Box(0.1, 0.3, ()),
    spaces.Box(np.array([[0, -3]]), np.array([[5, 2**40]]), dtype=np.int64),
    spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Tuple([spaces.Box(-1, 1, (1,)), spaces.Dict({"x": spaces.MultiBinary([1])})])}),
    spaces.Tuple([]),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_a_space_comes_back_as_it_was(space):
    text = json.dumps(space_to_json(space))
    found = space_from_json(json.loads(text))
    assert found == space
    assert type(found) is type(space)


def test_an_images_bounds_are_one_number():
    assert len(json.dumps(space_to_json(spaces.Box(0, 255, (84, 84, 4), np.uint8)))) < 120


def test_unknown_spaces_are_refused():
    with pytest.raises(UserError, match="spaces may be Discrete"):
        space_to_json(spaces.Text(5))
    with pytest.raises(UserError, match="unknown kind"):
        space_from_json({"kind": "Graph"})
