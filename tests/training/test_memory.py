"""What a learner will take is said before it is taken, and refused where it does not fit."""

import gymnasium.spaces as spaces
import numpy as np
import pytest

from thorndike.api.building import build_algorithm, full_config
from thorndike.errors import UserError
from thorndike.training import memory
from thorndike.types import Algorithm, EnvSpec

PONG = EnvSpec("pong", spaces.Box(0, 255, (84, 84, 4), np.uint8), spaces.Discrete(6), 4, frames=4)


def learner(buffer_size: int, spec: EnvSpec = PONG) -> Algorithm:
    return build_algorithm("dqn", full_config("dqn", {"buffer_size": buffer_size, "learning_starts": 100}), spec, None)


@pytest.fixture
def free(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 4_000_000_000)


def test_a_large_replay_is_announced_and_a_small_one_is_not(free, capsys):
    assert 3.5e9 < memory.check_memory("dqn", learner(480_000), 1, 480_000) < 4e9
    assert "the learner with its replay takes 3.6" in capsys.readouterr().err
    memory.check_memory("dqn", learner(1_000), 1, 1_000)
    assert capsys.readouterr().err == ""


def test_one_that_does_not_fit_is_refused_with_what_would(free):
    with pytest.raises(UserError, match=r"needs 7.5\d GB, 4 GB are available; set buffer_size to 4\d\d,\d\d\d or less$"):
        memory.check_memory("dqn", learner(1_000_000), 1, 1_000_000)
    with pytest.raises(UserError, match="or train fewer seeds at a time"):
        memory.check_memory("dqn", learner(400_000), 2, 400_000)


def test_frames_kept_once_take_an_eighth_of_whole_stacks(free):
    once, stacks = (memory.check_memory("dqn", learner(10_000, spec), 1, 10_000) for spec in (PONG, PONG._replace(frames=1)))
    assert 6 < stacks / once < 8


def test_what_linux_says_is_read(tmp_path):
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:    1000 kB\n")
    assert memory._free_of_machine(tmp_path / "meminfo") == 1_024_000
    assert memory._free_of_machine(tmp_path / "none") is None
    assert memory.available_memory() > 0


@pytest.mark.parametrize(
    ("membership", "folder", "names"),
    [
        ("0::/a/b\n", "a", ("memory.max", "memory.current", "inactive_file")),
        ("4:memory:/a/b\n0::/\n", "memory/a", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")),
    ],
)
def test_the_limit_of_a_control_group_above_counts(tmp_path, membership, folder, names):
    (tmp_path / "cgroup").write_text(membership)
    group = tmp_path / folder
    (group / "b").mkdir(parents=True)
    for name, text in zip(names, ("5000", "3000", None), strict=True):
        if text:
            (group / name).write_text(text + "\n")
    (group / "memory.stat").write_text(f"cache 7\n{names[2]} 500\n")
    (group / "b" / names[0]).write_text("max\n")
    (group / "b" / names[1]).write_text("10\n")
    assert memory._free_of_group(tmp_path, tmp_path / "cgroup") == 2500
