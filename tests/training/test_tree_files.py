"""Trees of arrays as files: bit for bit what was written, and nothing else accepted."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file

from thorndike.errors import UserError
from thorndike.training import tree_files
from thorndike.training.sealed_folders import Damaged, NewFolder, SealedFolder
from thorndike.training.tree_files import read_arrays, read_tree, save_tree, write_tree


class Pair(NamedTuple):
    left: object
    right: object


def tree():
    return {
        "a": Pair(jnp.array([1.5, jnp.nan, -jnp.inf]), (jnp.int32(7), ())),
        "flags": [jnp.array([True, False]), jnp.zeros((0, 3))],
        "picture": jnp.arange(6, dtype=jnp.uint8).reshape(2, 3).T,
        "half": jnp.array([1, 2], jnp.bfloat16),
        "key": jax.random.key(5),
        "keys": jax.random.split(jax.random.key(6), 3),
    }


def same(a, b) -> bool:
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        a, b = jax.random.key_data(a), jax.random.key_data(b)
    return a.dtype == b.dtype and a.shape == b.shape and np.asarray(a).tobytes() == np.asarray(b).tobytes()


def written(tree, parent: Path, **how) -> SealedFolder:
    new = NewFolder(parent / "aside")
    write_tree(tree, new, "t", **how)
    new.publish(parent / "folder")
    return SealedFolder(parent / "folder")


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("described", [False, True], ids=["arrays", "shapes"])
def test_a_tree_comes_back_bit_for_bit(tmp_path, monkeypatch, described, blocks):
    monkeypatch.setattr(tree_files, "LARGE", 0)
    monkeypatch.setattr(tree_files, "BLOCK", 4)
    folder = written(tree(), tmp_path, blocks=blocks)
    assert any(name.endswith(".block") for name in folder.names) == blocks
    found = read_tree(jax.eval_shape(tree) if described else tree(), folder, "t")
    assert jax.tree.structure(found) == jax.tree.structure(tree())
    assert all(map(same, jax.tree.leaves(found), jax.tree.leaves(tree())))


def test_a_tree_may_also_be_a_file_by_itself(tmp_path):
    save_tree({"a": jnp.arange(3), "b": (jnp.float32(2),)}, tmp_path / "t.safetensors")
    found = load_file(tmp_path / "t.safetensors")
    assert sorted(found) == ["a", "b/0"]
    np.testing.assert_array_equal(found["a"], [0, 1, 2])


def test_a_single_array_has_a_name_too(tmp_path):
    folder = written(jnp.arange(3), tmp_path)
    np.testing.assert_array_equal(read_tree(jnp.zeros(3, jnp.int32), folder, "t"), [0, 1, 2])


def test_only_large_arrays_are_cut_and_equal_blocks_are_one_file(tmp_path):
    buffer = np.zeros((3, 2**20), np.float32)
    buffer[1, 5] = 1
    folder = written({"small": np.zeros(2**18, np.float32), "large": buffer}, tmp_path, blocks=True)
    assert folder.names[2:] == ["t.blocks.json", "t.safetensors"]
    assert len(folder.names) == 4, "two blocks of zeros are one"
    assert (folder.path / "t.safetensors").stat().st_size < 2**20 + 200
    np.testing.assert_array_equal(read_arrays(folder, "t")["large"], buffer)


@pytest.mark.parametrize(
    ("like", "words"),
    [
        ({"a": jnp.zeros(3), "b": jnp.zeros(2)}, "no array 'b'"),
        ({"a": jnp.zeros(4)}, r"'a' is float32\[3\], but this environment and these settings need float32\[4\]"),
        ({"a": jnp.zeros(3, jnp.int32)}, "need int32"),
        ({"a": jax.random.key(0)}, "'a' is float32"),
        ({}, "has an array 'a' too many"),
    ],
)
def test_another_tree_is_refused_in_one_line(tmp_path, like, words):
    folder = written({"a": jnp.zeros(3)}, tmp_path)
    with pytest.raises(UserError, match=words) as error:
        read_tree(like, folder, "t")
    assert "\n" not in str(error.value)


def test_what_is_no_safetensors_file_is_damaged(tmp_path):
    new = NewFolder(tmp_path / "aside")
    new.write("t.safetensors", b"x" * 50)
    new.publish(tmp_path / "folder")
    with pytest.raises(Damaged, match="folder is damaged: t cannot be read"):
        read_arrays(SealedFolder(tmp_path / "folder"), "t")


def test_the_file_holds_no_code(tmp_path):
    content = written(tree(), tmp_path).read("t.safetensors")
    # safetensors: the length of a JSON header, the header, raw numbers.
    length = int.from_bytes(content[:8], "little")
    assert content[8:9] == b"{"
    assert b"a/left" in content[8 : 8 + length]
