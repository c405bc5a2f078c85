"""Trees of arrays as files: bit for bit what was written, and nothing else accepted."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.training.tree_files import load_tree, save_tree


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


@pytest.mark.parametrize("described", [False, True], ids=["arrays", "shapes"])
def test_a_tree_comes_back_bit_for_bit(tmp_path, described):
    save_tree(tree(), tmp_path / "t")
    like = jax.eval_shape(tree) if described else tree()
    found = load_tree(like, tmp_path / "t")
    assert jax.tree.structure(found) == jax.tree.structure(tree())
    assert all(map(same, jax.tree.leaves(found), jax.tree.leaves(tree())))


def test_a_single_array_has_a_name_too(tmp_path):
    save_tree(jnp.arange(3), tmp_path / "t")
    np.testing.assert_array_equal(load_tree(jnp.zeros(3, jnp.int32), tmp_path / "t"), [0, 1, 2])


@pytest.mark.parametrize(
    ("like", "words"),
    [
        ({"a": jnp.zeros(3), "b": jnp.zeros(2)}, "no array 'b'"),
        ({"a": jnp.zeros(4)}, r"'a' is float32\[3\], but this environment and these settings need float32\[4\]"),
        ({"a": jnp.zeros(3, jnp.int32)}, "need int32"),
        ({"a": jax.random.key(0)}, "'a' is float32"),
    ],
)
def test_another_tree_is_refused_in_one_line(tmp_path, like, words):
    save_tree({"a": jnp.zeros(3)}, tmp_path / "t")
    with pytest.raises(UserError, match=words) as error:
        load_tree(like, tmp_path / "t")
    assert "\n" not in str(error.value)


def test_the_file_holds_no_code(tmp_path):
    save_tree(tree(), tmp_path / "t")
    content = (tmp_path / "t").read_bytes()
    # safetensors: the length of a JSON header, the header, raw numbers.
    length = int.from_bytes(content[:8], "little")
    assert content[8:9] == b"{"
    assert b"a/left" in content[8 : 8 + length]
