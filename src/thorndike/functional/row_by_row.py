"""Learning in a table one row after another, compiled, for one seed or for many."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, PyTree

Tables = TypeVar("Tables")
Row = TypeVar("Row")
Result = TypeVar("Result")


def row_by_row(
    learn_row: Callable[[Tables, Int[Array, ""], Row], tuple[Tables, Result]], seeds: int = 1
) -> Callable[[Tables, Row], tuple[Tables, Result]]:
    """Scan `learn_row(tables, seed, row) -> tables, result` over the rows ``[N, ...]``: each sees the tables the one before left.

    Under vmap the tables of all seeds are laid behind one another along their leading axis and all their rows are learnt in one scan.
    `seed` says whose row it is: `learn_row` must offset its positions by ``seed * (length of one seed's table)``.
    """

    # Left to itself, vmap would turn slices at scalar positions into scatters: XLA on the CPU keeps no loop with a scatter in one kernel.
    @jax.custom_batching.custom_vmap
    def learn(tables: Tables, rows: Row) -> tuple[Tables, Result]:
        total = jax.tree.leaves(rows)[0].shape[0]
        seed = jnp.arange(total, dtype=jnp.int32) // (total // seeds)
        return lax.scan(lambda carry, numbered: learn_row(carry, *numbered), tables, (seed, rows))

    @learn.def_vmap
    def learn_all(axis_size: int, in_batched: PyTree, tables: Tables, rows: Row) -> tuple[PyTree, PyTree]:
        def merge(x: Array, batched: bool) -> Array:
            x = x if batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            return x.reshape(-1, *x.shape[2:])

        merged = jax.tree.map(merge, (tables, rows), tuple(in_batched))
        learnt = row_by_row(learn_row, seeds * axis_size)(*merged)
        split = jax.tree.map(lambda x: x.reshape(axis_size, -1, *x.shape[1:]), learnt)
        return split, jax.tree.map(lambda _: True, split)

    return learn
