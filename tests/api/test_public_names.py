"""The public API: every name can be had, and every learner of an agent has a class."""

from pathlib import Path

import pytest

import thorndike as td
from thorndike import api
from thorndike.algorithms import ALGORITHMS

CLASSES = {name: getattr(td, name) for name in td.__all__ if isinstance(getattr(td, name), type)}
LEARNERS = {made.algorithm: name for name, made in CLASSES.items() if issubclass(made, api.Learner) and made is not api.Learner}


@pytest.mark.parametrize("name", td.__all__)
def test_every_public_name_can_be_had(name):
    assert getattr(td, name) is not None
    assert name in dir(td)


def test_every_algorithm_that_trains_an_agent_has_a_class():
    assert set(LEARNERS) == set(ALGORITHMS) - {"planning"}
    page = (Path(__file__).parents[2] / "docs" / "README.md").read_text(encoding="utf-8")
    assert all(f"`td.{name}`" in page for name in LEARNERS.values())


def test_what_there_is_not_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'PPOO'"):
        getattr(td, "PP" + "OO")
