import gymnasium
import numpy as np
import pytest

from thorndike.algorithms.planning import policy_iteration
from thorndike.environments.native.table import read_table
from thorndike.errors import UserError
from thorndike.plotting.grid_world import picture, read_grid, save_picture


def solved(name, **options):
    environment = gymnasium.make(name, **options)
    solution = policy_iteration(read_table(environment), 0.99)
    return read_grid(environment), solution.values, solution.policy


def test_a_lake_shows_an_arrow_on_every_tile_that_is_walked():
    text = picture(*solved("FrozenLake-v1"))
    first = text.splitlines()[1:3]
    assert [cell.split() for cell in first[0].strip("|").split("|")] == [["S", "←"], ["F", "↑"], ["F", "↑"], ["F", "↑"]]
    assert "0.5420" in first[1]
    assert sum(text.count(arrow) for arrow in "←↓→↑") == 16 - 4 - 1


def test_the_way_along_the_cliff_runs_right_then_down():
    lines = picture(*solved("CliffWalking-v1")).splitlines()
    assert lines[7].count("→") == 11
    assert lines[7].count("↓") == 1
    assert lines[10].count("C") == 10
    assert lines[10].split("|")[1].split() == ["S", "↑"]


def test_a_task_without_a_map_becomes_a_list_of_states():
    grid, values, policy = solved("Taxi-v4")
    assert grid is None
    lines = picture(grid, values, policy).splitlines()
    assert len(lines) == 501
    assert lines[1].split() == ["0", str(policy[0]), f"{values[0]:.6f}"]


def test_values_of_another_map_are_refused():
    grid, _, _ = solved("FrozenLake-v1")
    with pytest.raises(UserError, match="16 tiles"):
        picture(grid, np.zeros(4), np.zeros(4, int))


def test_the_picture_is_saved_as_a_png(tmp_path):
    path = save_picture(*solved("FrozenLake-v1", map_name="8x8"), tmp_path / "lake.png")
    assert path.read_bytes().startswith(b"\x89PNG")
