"""Pytrees of arrays as safetensors files: nothing executable, names are the paths in the tree."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from safetensors.numpy import load_file, save_file

from thorndike.errors import UserError


def save_tree(tree: PyTree, path: Path) -> None:
    """Write every array of ``tree`` under its path; typed PRNG keys as their raw words."""
    save_file({name: np.asarray(_plain(leaf), order="C") for name, leaf in _named(tree)}, path)


def load_tree(like: PyTree, path: Path) -> PyTree:
    """Read a tree of the structure of ``like`` (arrays or shapes).

    Raises ``UserError`` if the file holds other names, shapes or dtypes.
    """
    stored = load_file(path)
    leaves = []
    for name, leaf in _named(like):
        if name not in stored:
            raise UserError(f"{path} has no array {name!r}: it was written by another algorithm, network or version")
        array = stored[name]
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        shape = jax.eval_shape(jax.random.key_data, leaf).shape if is_key else leaf.shape
        if array.shape != shape or (not is_key and array.dtype != leaf.dtype):
            raise UserError(
                f"{path}: {name!r} is {array.dtype}{list(array.shape)}, but this environment and these settings need "
                f"{leaf.dtype}{list(shape)}"
            )
        leaves.append(jax.random.wrap_key_data(jnp.asarray(array)) if is_key else jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(tree: PyTree) -> list[tuple[str, jax.Array]]:
    return [(jax.tree_util.keystr(path, simple=True, separator="/") or "value", leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def _plain(leaf: jax.Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
