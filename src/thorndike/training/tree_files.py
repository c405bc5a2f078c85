"""Pytrees of arrays as files of a sealed folder: nothing executable, names are the paths in the tree.

Small arrays are one safetensors file. Arrays above 1 MiB, such as a replay buffer, are cut into blocks of 4 MiB, a file each that is named
after its hash; ``<tree>.blocks.json`` says which make up which array. A block that the folder already has, or that a folder written before
has, is not written again.
"""

import math
from collections.abc import Container
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree
from safetensors import SafetensorError, deserialize
from safetensors.numpy import save

from thorndike.errors import UserError
from thorndike.training.json_files import Json, as_bytes, parse_object
from thorndike.training.sealed_folders import Damaged, NewFolder, SealedFolder

LARGE = 2**20
"""Bytes above which an array is cut into blocks."""
BLOCK = 2**22
_DTYPES = {
    "F64": "float64", "F32": "float32", "F16": "float16", "BF16": "bfloat16", "BOOL": "bool", "C64": "complex64",
    **{f"{letter}{bits}": f"{word}{bits}" for letter, word in (("I", "int"), ("U", "uint")) for bits in (8, 16, 32, 64)},
}  # fmt: skip
"""As safetensors calls them, and as NumPy does."""


def write_tree(tree: PyTree, folder: NewFolder, name: str, *, blocks: bool = False, donor: Path | None = None) -> None:
    """Write every array of ``tree`` under its path into ``name.safetensors``; typed PRNG keys as their raw words.

    With ``blocks``, large ones in blocks of their own, shared with the folder ``donor`` where it has the same.
    """
    arrays = named_arrays(tree)
    large = {key: array for key, array in arrays.items() if blocks and array.nbytes > LARGE}
    folder.write(f"{name}.safetensors", save({key: array for key, array in arrays.items() if key not in large}))
    if large:
        folder.write(f"{name}.blocks.json", as_bytes({key: _write_blocks(array, folder, donor) for key, array in large.items()}))


def save_tree(tree: PyTree, path: Path) -> None:
    """Write every array of ``tree`` into one safetensors file by itself, outside any sealed folder."""
    path.write_bytes(save(named_arrays(tree)))


def read_tree(like: PyTree, folder: SealedFolder, name: str, *, part: bool = False) -> PyTree:
    """Read a tree of the structure of ``like`` (arrays or shapes).

    With ``part`` there may be other arrays too; those that are cut into blocks are then not read. Raises ``Damaged`` where the files are
    not what was written, ``UserError`` if they hold other names, shapes or dtypes.
    """
    wanted = dict(_named(like))
    stored = read_arrays(folder, name, wanted if part else None)
    leaves = []
    for key, leaf in wanted.items():
        if key not in stored:
            raise UserError(f"{folder.path} has no array {key!r}: it was written by another algorithm, network or version")
        leaves.append(_as_leaf(stored.pop(key), leaf, f"{folder.path}: {key!r}"))
    for key in () if part else stored:
        raise UserError(f"{folder.path} has an array {key[:80]!r} too many: it was written by another algorithm, network or version")
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def read_arrays(folder: SealedFolder, name: str, wanted: Container[str] | None = None) -> dict[str, np.ndarray]:
    """Every array of a tree by its path; of those in blocks only the ``wanted`` ones. Raises ``Damaged``."""
    try:
        views = deserialize(folder.read(f"{name}.safetensors"))
        arrays = {key: _array(view["data"], view["dtype"], view["shape"]) for key, view in views}
        if f"{name}.blocks.json" in folder:
            described = parse_object(folder.read(f"{name}.blocks.json"), folder.path)
            arrays |= {key: _read_blocks(facts, folder) for key, facts in described.items() if wanted is None or key in wanted}
    except Damaged:
        raise
    except (SafetensorError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise Damaged(f"{folder.path} is damaged: {name} cannot be read: {str(error)[:200]}") from None
    return arrays


def named_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """Every array of a tree by its path; typed PRNG keys as their raw words."""
    return {name: np.asarray(_plain(leaf), order="C") for name, leaf in _named(tree)}


def _write_blocks(array: np.ndarray, folder: NewFolder, donor: Path | None) -> Json:
    flat = memoryview(array.reshape(-1).view(np.uint8).data)
    names = [folder.share(flat[start : start + BLOCK], ".block", donor) for start in range(0, array.nbytes, BLOCK)]
    return {"dtype": array.dtype.name, "shape": list(array.shape), "blocks": names}


def _read_blocks(facts: object, folder: SealedFolder) -> np.ndarray:
    match facts:
        case {"dtype": str(dtype), "shape": list(shape), "blocks": list(blocks)} if dtype in _DTYPES.values():
            content = bytearray()
            for name in blocks:
                content += folder.read(str(name))
            return _array(content, dtype, shape)
    raise Damaged(f"{folder.path} is damaged: what it says of a large array is not what was written")


def _array(data: bytes | bytearray, dtype: str, shape: list) -> np.ndarray:
    kind = jnp.dtype(_DTYPES.get(dtype, dtype))
    if not all(type(size) is int and size >= 0 for size in shape) or math.prod(shape) * kind.itemsize != len(data):
        raise ValueError(f"{len(data)} bytes are no {kind}{shape}")
    return np.frombuffer(data, kind).reshape(shape)


def _as_leaf(array: np.ndarray, leaf: Array | jax.ShapeDtypeStruct, where: str) -> Array:
    """The array as the leaf it is to be. Raises ``UserError`` if it has another shape or dtype."""
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    shape = jax.eval_shape(jax.random.key_data, leaf).shape if is_key else leaf.shape
    if array.shape != shape or array.dtype != (np.uint32 if is_key else leaf.dtype):
        raise UserError(
            f"{where} is {array.dtype}{list(array.shape)}, but this environment and these settings need {leaf.dtype}{list(shape)}"
        )
    # A copy: the array is going to be donated.
    own = jnp.array(array)
    return jax.random.wrap_key_data(own) if is_key else own


def _named(tree: PyTree) -> list[tuple[str, Array]]:
    return [(jax.tree_util.keystr(path, simple=True, separator="/") or "value", leaf) for path, leaf in jax.tree.leaves_with_path(tree)]


def _plain(leaf: Array) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)
