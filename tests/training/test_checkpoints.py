"""Checkpoints: whatever fails, and wherever, the newest good one is gone on from, and damage is named."""

import contextlib
import json
import os
import random
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save

from thorndike.errors import UserError
from thorndike.training import tree_files
from thorndike.training.checkpoints import Progressed, read_actors, restore, save_checkpoint
from thorndike.training.json_files import as_bytes
from thorndike.training.run_directory import checkpoints
from thorndike.training.runner import Runner
from thorndike.training.sealed_folders import NewFolder, SealedFolder, intact
from thorndike.training.segment import Carry
from thorndike.types import Algorithm
from training.damage import DAMAGES, HOSTILE, seal_again
from training.faulty_disk import Dead, disk, dying_at, failing_at

PER_ITERATION = 10
LONG = 5_000
REQUEST = {"seed": 3, "steps": 100, "config": {"gamma": 0.9}}


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Buffers of kilobytes are cut as those of gigabytes are."""
    monkeypatch.setattr(tree_files, "LARGE", 1024)
    monkeypatch.setattr(tree_files, "BLOCK", 4096)


def carry_at(iteration: int) -> Carry:
    """A learner whose buffer of 20 kB has been filled up to 1 kB an iteration."""
    ring = np.zeros(LONG, np.float32)
    ring[: 250 * iteration] = 1 + np.arange(250 * iteration)
    learner = {"params": jnp.full((3, 2), iteration, jnp.float32), "ring": jnp.asarray(ring), "count": jnp.int32(iteration)}
    return Carry(learner, {"key": jax.random.key(iteration)}, jax.random.key(9))


def runner_of(carry: Carry) -> Runner:
    return Runner(lambda: carry, None, PER_ITERATION, lambda: 0.0, lambda: 0.0)


RUNNER = runner_of(carry_at(0))


def save_at(run: Path, iteration: int) -> None:
    save_checkpoint(run, carry_at(iteration), None, Progressed(iteration, 1.5, 2.5), PER_ITERATION, REQUEST)


def learning(init, actor) -> Algorithm:
    """One that does nothing but begin and act."""
    rest = dict.fromkeys(("memory", "draw", "act", "greedy", "value", "update", "observe", "needs"))
    return Algorithm(init=init, actor=actor, **rest)


def restored(run: Path, request: dict = REQUEST) -> int:
    """The iteration gone on from, every array of it compared."""
    carry, progressed = restore(run, RUNNER, None, request)
    expected = carry_at(progressed.iteration)._replace(loop_key=RUNNER.init().loop_key)
    assert jax.tree.structure(carry) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(carry), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        assert jnp.array_equal(ours, theirs)
    return progressed.iteration


@pytest.fixture
def run(tmp_path) -> Path:
    """Two checkpoints, of iterations 1 and 2."""
    (tmp_path / "run").mkdir()
    for iteration in (1, 2):
        save_at(tmp_path / "run", iteration)
    return tmp_path / "run"


def names(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "checkpoints").iterdir())


def test_the_two_newest_are_kept_and_nothing_is_left_aside(run):
    save_at(run, 3)
    (run / "checkpoints" / "of the user").mkdir()
    save_at(run, 4)
    assert names(run) == ["30", "40", "of the user"]
    assert restored(run) == 4
    assert restore(run, RUNNER, None)[1] == Progressed(4, 1.5, 2.5)


def inodes(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_ino for path in folder.glob("*.block")}


def test_blocks_that_did_not_change_are_not_written_again_and_the_two_kept_share_nothing(run):
    before = inodes(run / "checkpoints" / "10")
    save_at(run, 3)
    oldest, newest = inodes(run / "checkpoints" / "20"), inodes(run / "checkpoints" / "30")
    # 20,000 bytes are five blocks; of three filled kilobytes all lie in the first, and three of the others are zeros alone.
    assert len(newest) == 3
    assert sum(newest.get(name) == inode for name, inode in before.items()) == 2
    assert not set(oldest.values()) & set(newest.values())


def test_where_files_cannot_have_two_names_blocks_are_written(run, monkeypatch):
    def refuse(*arguments, **named):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    save_at(run, 3)
    assert restored(run) == 3


def test_a_block_that_was_damaged_since_is_written_anew(run):
    for block in (run / "checkpoints" / "10").glob("*.block"):
        block.write_bytes(b"x" + block.read_bytes()[1:])
    save_at(run, 3)
    assert restored(run) == 3


def test_every_file_is_flushed_before_the_folder_appears_and_its_folder_after(run):
    opened, order = {}, []
    real_open, donors = os.open, inodes(run / "checkpoints" / "10").values()

    def note(watched, name, arguments):
        if name == "fsync":
            order.append(("flush", opened[arguments[0]]))
        if name == "rename":
            order.append(("rename", str(arguments[0]), str(arguments[1])))

    def open_noted(path, *rest, **named):
        descriptor = real_open(path, *rest, **named)
        opened[descriptor] = str(path)
        return descriptor

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "open", open_noted)
        with disk(note):
            save_at(run, 3)
    folder = run / "checkpoints"
    renamed = order.index(("rename", str(folder / "partial"), str(folder / "30")))
    flushed = {entry[1] for entry in order[:renamed]}
    written = {path.name for path in (folder / "30").iterdir() if path.stat().st_ino not in donors}
    assert len(written) == 5, "a block, and the four that describe"
    assert flushed >= {str(folder / "partial" / name) for name in written}
    assert order[renamed - 1] == ("flush", str(folder / "partial"))
    assert order[renamed + 1] == ("flush", str(folder))


def calls_of_a_save(run: Path, iteration: int) -> int:
    with disk() as watched:
        save_at(run, iteration)
    return len(watched.made)


def fresh_copy(run: Path, number: int) -> Path:
    return Path(shutil.copytree(run, run.with_name(f"copy-{number}")))


@pytest.mark.parametrize("replaced", [False, True], ids=["new", "in place of a damaged one"])
@pytest.mark.parametrize("mode", [failing_at, dying_at])
def test_whatever_call_of_a_save_fails_or_is_the_last_the_newest_good_one_is_gone_on_from(run, mode, replaced):
    if replaced:
        save_at(run, 3)
        (run / "checkpoints" / "30" / "progress.json").write_bytes(b"")
    total = calls_of_a_save(fresh_copy(run, 0), 3)
    assert total > 40
    new = 0
    for number in range(1, total + 1):
        copy = fresh_copy(run, number)
        done = True
        with disk(mode(number)) as watched:
            try:
                save_at(copy, 3)
            except (OSError, Dead):
                done = False
        assert len(watched.made) >= number
        found = restored(copy)
        assert found == 3 if done else found in (2, 3), f"call {number}, {watched.made[number - 1]}"
        new += found == 3
        with disk():
            save_at(copy, 4)
        assert restored(copy) == 4, f"after call {number}, {watched.made[number - 1]}"
        assert len(checkpoints(copy)) == 2
        shutil.rmtree(copy)
    assert 0 < new < total


@pytest.mark.parametrize("mode", [failing_at, dying_at])
def test_whatever_call_fails_a_policy_is_the_old_or_the_new_one(tmp_path, mode):
    def export(run: Path, content: bytes) -> None:
        new = NewFolder(run / "policy.partial")
        new.write("policy.json", content)
        new.publish(run / "policy")

    def held(run: Path) -> bytes:
        folder = next(folder for folder in (run / "policy", run / "policy.old") if folder.is_dir())
        return SealedFolder(folder).read("policy.json")

    (tmp_path / "run").mkdir()
    export(tmp_path / "run", b"first")
    export(tmp_path / "run", b"old")
    with disk() as counted:
        export(fresh_copy(tmp_path / "run", 0), b"new")
    found = set()
    for number in range(1, len(counted.made) + 1):
        copy = fresh_copy(tmp_path / "run", number)
        for content in (b"new", b"newer"):
            with disk(mode(number)), contextlib.suppress(OSError, Dead):
                export(copy, content)
            found.add(held(copy))
        export(copy, b"last")
        assert held(copy) == b"last"
        assert [path.name for path in copy.iterdir()] == ["policy"]
    assert found == {b"old", b"new", b"newer"}


def damaged_checkpoints(run: Path, number: int, capsys) -> None:
    """Damage the newest checkpoint in ``number`` ways: each is named in one line, and the one before it is gone on from."""
    for seed in range(number):
        chance = random.Random(seed)
        copy = fresh_copy(run, seed)
        damage = chance.choice(DAMAGES)
        damage(copy / "checkpoints" / "20", chance)
        capsys.readouterr()
        assert restored(copy) == 1, f"{damage.__name__}, {seed}"
        told = capsys.readouterr().err
        assert told.count("\n") == 1, told
        assert str(copy / "checkpoints" / "20") in told and "going on from the checkpoint before it, of step 10" in told
        assert names(copy) == ["10", "20.damaged"]
        damage(copy / "checkpoints" / "10", chance)
        with pytest.raises(UserError, match="has no intact checkpoint to go on from") as error:
            restored(copy)
        assert "\n" not in str(error.value) and len(str(error.value)) < 1000
        shutil.rmtree(copy)


def test_damage_is_named_and_the_checkpoint_before_is_gone_on_from(run, capsys):
    damaged_checkpoints(run, 60, capsys)


@pytest.mark.slow
def test_a_thousand_damages_are_named_and_the_checkpoint_before_is_gone_on_from(run, capsys):
    damaged_checkpoints(run, 1000, capsys)


@pytest.mark.parametrize("content", HOSTILE, ids=range(len(HOSTILE)))
@pytest.mark.parametrize("name", ["progress.json", "state.blocks.json", "manifest.json"])
def test_hostile_json_is_one_line(run, name, content, capsys):
    path = run / "checkpoints" / "20" / name
    path.write_bytes(content)
    if name != "manifest.json":
        seal_again(path.parent)
    assert restored(run) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and len(told) < 1000


def test_a_checkpoint_under_the_name_of_another_step_is_damaged(run, capsys):
    (run / "checkpoints" / "20").rename(run / "checkpoints" / "70")
    assert restored(run) == 1
    assert "it holds iteration 2, which is another step" in capsys.readouterr().err


def test_a_request_that_was_changed_since_is_refused_but_for_the_number_of_steps(run):
    assert restored(run, REQUEST | {"steps": 500, "more": 1}) == 2
    for changed in ({"seed": 4}, {"config": {"gamma": 0.99}}):
        with pytest.raises(UserError, match=f"its checkpoints were made with {next(iter(changed))} = "):
            restored(run, REQUEST | changed)


def test_checkpoints_of_the_first_format_are_read(run):
    """Hashes without sizes, and no request."""
    for path in checkpoints(run):
        shutil.rmtree(path)
    folder = run / "checkpoints" / "20"
    folder.mkdir()
    arrays = tree_files.named_arrays((carry_at(2).learner, carry_at(2).source))
    (folder / "state.safetensors").write_bytes(save(arrays))
    (folder / "progress.json").write_text(json.dumps({"iteration": 2, "wall_s": 1.0, "cpu_s": 2.0}))
    new = NewFolder(run / "other")
    for name in ("state.safetensors", "progress.json"):
        new.write(name, (folder / name).read_bytes())
    hashes = {name: seal.sha256 for name, seal in new._seals.items()}
    (folder / "manifest.json").write_bytes(as_bytes({"sha256": hashes}))
    assert intact(folder)
    assert restored(run) == 2


def test_lines_logged_after_the_checkpoint_are_dropped(run):
    lines = [json.dumps({"steps": steps}) + "\n" for steps in (10, 20, 30)]
    (run / "metrics.jsonl").write_text("".join(lines) + '{"steps": 4')
    restored(run)
    assert (run / "metrics.jsonl").read_text() == "".join(lines[:2])


def test_without_a_checkpoint_that_is_said(tmp_path):
    with pytest.raises(UserError, match="no intact checkpoint to go on from; train again"):
        restore(tmp_path, RUNNER, None)


def test_as_many_checkpoints_stay_as_are_asked_for_and_the_newest_two_share_nothing(tmp_path):
    for iteration in range(1, 6):
        save_checkpoint(tmp_path, carry_at(iteration), None, Progressed(iteration, 1.5, 2.5), PER_ITERATION, REQUEST, keep=4)
    assert [path.name for path in checkpoints(tmp_path)] == ["20", "30", "40", "50"]
    files = [{path.stat().st_ino for path in folder.iterdir()} for folder in checkpoints(tmp_path)]
    assert not files[-1] & files[-2]
    assert restored(tmp_path) == 5


@pytest.mark.parametrize("compiled", [True, False])
def test_what_acts_is_read_without_the_replay(tmp_path, monkeypatch, compiled):
    """Two seeds; a wrapper that is not asked for stands before the one whose statistics are."""

    def learner(count):
        # None, as the gate of an AlphaZero that has none.
        arrays = {"params": jnp.full((3, 2), count, jnp.float32), "ring": jnp.zeros(LONG) + count, "count": jnp.int32(count)}
        return {**arrays, "gate": None}

    def both(tree):
        return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf + 1]), tree)

    held = {"mean": jnp.arange(4.0)}
    statistics = ({"seen": jnp.ones(())}, held)
    source = {"environment": jnp.zeros(()), "statistics": statistics} if compiled else statistics
    algorithm = learning(lambda key: learner(0), lambda state: {"policy": state["params"] * state["count"]})
    save_checkpoint(tmp_path, Carry(both(learner(3)), both(source), jax.random.key(9)), None, Progressed(1, 1.5, 2.5), PER_ITERATION)
    read = []
    monkeypatch.setattr(SealedFolder, "read", lambda self, name, plain=SealedFolder.read: read.append(name) or plain(self, name))
    actors, learnt = read_actors(tmp_path / "checkpoints" / "10", algorithm, {1: jax.eval_shape(lambda: held)}, 2, compiled)
    np.testing.assert_array_equal(actors["policy"], np.stack([np.full((3, 2), 9.0), np.full((3, 2), 16.0)]))
    np.testing.assert_array_equal(learnt[0]["mean"], np.stack([np.arange(4.0), np.arange(4.0) + 1]))
    assert sorted(read) == ["state.blocks.json", "state.safetensors"]
