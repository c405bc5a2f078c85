"""A run's directory: never overwritten, never half written, damage found."""

import contextlib
import json
import os
import re

import pytest

from thorndike.errors import UserError
from thorndike.training.run_directory import (
    append_lines,
    checkpoints,
    facts,
    new_run_directory,
    read_lines,
    read_run,
    refuse_if_gone,
    truncate_lines,
    write_json,
)
from training.faulty_disk import Dead, disk, dying_at, failing_at


def test_every_run_gets_a_directory_of_its_own(tmp_path):
    runs = [new_run_directory(tmp_path, "CartPole-v1", "ppo", "same") for _ in range(5)]
    assert len(set(runs)) == 5
    assert all(run.is_dir() and run.parent == tmp_path / "CartPole-v1" / "ppo" for run in runs)
    assert re.fullmatch(r"\d{8}-\d{6}-same", runs[0].name)


@pytest.mark.parametrize(
    ("environment", "name", "folder", "label"),
    [
        ("ALE/Pong-v5", None, "ALE-Pong-v5", "run"),
        ("../../etc/passwd.py:Evil", "../up", "etc-passwd.py-Evil", "up"),
        ("..", "a b/c", "environment", "a-b-c"),
    ],
)
def test_names_never_lead_out_of_the_output_directory(tmp_path, environment, name, folder, label):
    run = new_run_directory(tmp_path, environment, "ppo", name)
    assert run.parent == tmp_path / folder / "ppo"
    assert run.name.endswith(f"-{label}")


def test_an_output_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="choose another with --output"):
        new_run_directory(tmp_path / "file", "CartPole-v1", "ppo", None)


def test_a_run_is_read_as_it_was_written(tmp_path):
    content = {**facts(), "algorithm": "ppo", "steps": 5}
    write_json(tmp_path / "run.json", content)
    assert read_run(tmp_path) == content
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"], "nothing is left aside"


def test_the_facts_say_how_to_make_the_run_again():
    found = facts()
    assert {"thorndike", "jax", "jaxlib", "numpy", "gymnasium", "python"} <= set(found["versions"])
    assert {"platform", "git_commit", "created", "processors", "format"} <= set(found)
    assert set(found["machine"]) == {"processor", "features", "xla_flags", "self_test"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "is no run"),
        (b"{half", "is damaged"),
        (b'{"format": 99}', "has format 99"),
        (b"{}", "has format None"),
        (b"\xff\xfe\x00", "is damaged"),
        (b"[]", "expected an object"),
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a": ' * 100 + b"1" + b"}" * 100, "nested too deeply"),
        (b'{"format": ' + b"1" * 5000 + b"}", "is damaged"),
        (b'{"format": "' + b"1\\n" * 5000 + b'"}', "has format '1"),
    ],
)
def test_what_is_no_run_is_named_in_one_line(tmp_path, text, words):
    if text is not None:
        (tmp_path / "run.json").write_bytes(text)
    with pytest.raises(UserError, match=words) as error:
        read_run(tmp_path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 500


@pytest.mark.parametrize("mode", [failing_at, dying_at])
def test_whatever_call_fails_run_json_is_the_old_or_the_new_one(tmp_path, mode):
    path = tmp_path / "run.json"
    write_json(path, {"format": 1, "is": "old"})
    with disk() as counted:
        write_json(path, {"format": 1, "is": "old"})
    for number in range(1, len(counted.made) + 1):
        with disk(mode(number)), contextlib.suppress(OSError, Dead):
            write_json(path, {"format": 1, "is": "new"})
        assert read_run(tmp_path)["is"] in ("old", "new")
    write_json(path, {"format": 1, "is": "last"})
    assert read_run(tmp_path)["is"] == "last"


def test_lines_are_appended_all_or_none(tmp_path):
    path = tmp_path / "metrics.jsonl"
    append_lines(path, [{"steps": 10}])
    real_write = os.write

    def fill_up(watched, name, arguments):
        if name == "write":
            real_write(arguments[0], bytes(arguments[1])[:5])
            raise OSError(28, "No space left on device")

    with disk(fill_up), pytest.raises(OSError, match="No space left"):
        append_lines(path, [{"steps": 20}, {"steps": 30}])
    assert read_lines(path) == [{"steps": 10}]
    append_lines(path, [{"steps": 20}])
    assert path.read_text() == '{"steps": 10}\n{"steps": 20}\n'


def test_a_directory_that_is_gone_is_named(tmp_path):
    refuse_if_gone(tmp_path)
    with pytest.raises(UserError, match="run is gone, with all that was kept in it: training stopped"):
        refuse_if_gone(tmp_path / "run")


def test_lines_after_the_last_checkpoint_are_dropped_and_half_a_line_too(tmp_path):
    path = tmp_path / "metrics.jsonl"
    append_lines(path, [{"steps": 10}, {"steps": 20}])
    append_lines(path, [{"steps": 30}])
    with path.open("ab") as file:
        file.write(b'{"steps": NaN}\n[5]\n\xff\n{"steps": "5"}\n{"steps": 1')
    truncate_lines(path, 20)
    assert [json.loads(line) for line in path.read_text().splitlines()] == [{"steps": 10}, {"steps": 20}]
    truncate_lines(tmp_path / "none.jsonl", 20)
    assert not (tmp_path / "none.jsonl").exists()


def test_checkpoints_are_ordered_by_step_and_unfinished_ones_are_none(tmp_path):
    for name in ("900", "1000", "partial", "20", "30.old", "40.damaged", "²"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    assert [path.name for path in checkpoints(tmp_path)] == ["20", "900", "1000"]
