"""A run's directory: never overwritten, never half written, damage found."""

import json
import re

import pytest

from thorndike.errors import UserError
from thorndike.training.run_directory import (
    append_lines,
    checkpoints,
    facts,
    intact,
    new_run_directory,
    publish,
    read_run,
    seal,
    truncate_lines,
    write_json,
)


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


@pytest.mark.parametrize(
    ("text", "words"),
    [(None, "is no run"), ("{half", "is damaged"), ('{"format": 99}', "has format 99"), ("{}", "has format None")],
)
def test_what_is_no_run_is_named_in_one_line(tmp_path, text, words):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    with pytest.raises(UserError, match=words) as error:
        read_run(tmp_path)
    assert "\n" not in str(error.value)


def test_lines_after_the_last_checkpoint_are_dropped_and_half_a_line_too(tmp_path):
    path = tmp_path / "metrics.jsonl"
    append_lines(path, [{"steps": 10}, {"steps": 20}])
    append_lines(path, [{"steps": 30}])
    with path.open("a") as file:
        file.write('{"steps": 1')
    truncate_lines(path, 20)
    assert [json.loads(line) for line in path.read_text().splitlines()] == [{"steps": 10}, {"steps": 20}]
    truncate_lines(tmp_path / "none.jsonl", 20)
    assert not (tmp_path / "none.jsonl").exists()


def damaged(folder):
    (folder / "data").write_bytes(b"other")


def shortened(folder):
    (folder / "data").write_bytes(b"")


def removed(folder):
    (folder / "data").unlink()


def without_manifest(folder):
    (folder / "manifest.json").unlink()


def with_a_damaged_manifest(folder):
    (folder / "manifest.json").write_text('{"sha256"')


@pytest.mark.parametrize("harm", [damaged, shortened, removed, without_manifest, with_a_damaged_manifest])
def test_damage_is_found(tmp_path, harm):
    (tmp_path / "data").write_bytes(b"some bytes")
    seal(tmp_path)
    assert intact(tmp_path)
    harm(tmp_path)
    assert not intact(tmp_path)


def test_publishing_replaces_a_folder_as_a_whole(tmp_path):
    for content in (b"old", b"new"):
        aside = tmp_path / "partial"
        aside.mkdir()
        (aside / "data").write_bytes(content)
        publish(aside, tmp_path / "policy")
    assert (tmp_path / "policy" / "data").read_bytes() == b"new"
    assert intact(tmp_path / "policy")
    assert not (tmp_path / "partial").exists()


def test_checkpoints_are_ordered_by_step_and_unfinished_ones_are_none(tmp_path):
    for name in ("900", "1000", "partial", "20"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    assert [path.name for path in checkpoints(tmp_path)] == ["20", "900", "1000"]
