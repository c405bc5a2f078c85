"""Several devices: each trains its share of the seeds, or, where one model has them all, of every batch's rows.

What a seed computes does not depend on how many there are; a model whose rows are shared sums its gradient in another order, and differs in
the last bits. A CPU counts as several devices too, one a core: seeds that took turns on one core then train at the same time (startup.py).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import PyTree

_AXIS = "seeds"
_ROWS = "rows"


def devices_for(seeds: int, at_most: int) -> int:
    """How many of ``at_most`` devices get the same number of seeds each: the largest number that divides ``seeds``."""
    return max(number for number in range(1, max(1, min(seeds, at_most)) + 1) if seeds % number == 0)


def over_devices(function: Callable, devices: int) -> Callable:
    """``function(carry, *numbers)`` whose carry, and all it returns, lead with the seed axis, with that axis cut into a share a device."""
    if devices == 1:
        return function

    def share(carry: PyTree, *numbers: PyTree) -> PyTree:
        specs = (Spec(_AXIS), *(Spec() for _ in numbers))
        return jax.shard_map(function, mesh=_mesh(devices), in_specs=specs, out_specs=Spec(_AXIS), check_vma=False)(carry, *numbers)

    return share


def placed(tree: PyTree, devices: int) -> PyTree:
    """Leaves that lead with the seed axis, each share where it is computed. A tree that lies there already is given back."""
    return tree if devices == 1 else jax.device_put(tree, NamedSharding(_mesh(devices), Spec(_AXIS)))


@contextmanager
def sharing_rows(devices: int) -> Iterator[None]:
    """While it lasts, ``rows_shared`` cuts batches into a share a device. With one device nothing is different."""
    if devices == 1:
        yield
        return
    with jax.set_mesh(_mesh(devices, _ROWS)):
        yield


def rows_shared(batch: PyTree) -> PyTree:
    """Arrays with the rows of a batch in front, a share on each device; whole everywhere where they do not divide into shares."""
    mesh = jax.sharding.get_abstract_mesh()
    if _ROWS not in mesh.axis_names:
        return batch
    number = mesh.shape[_ROWS]

    def share(leaf: jax.Array) -> jax.Array:
        divides = leaf.ndim > 0 and leaf.shape[0] % number == 0
        return _laid_out(leaf, Spec(_ROWS) if divides else Spec())

    return jax.tree.map(share, batch)


def same_everywhere(tree: PyTree) -> PyTree:
    """Arrays that every device has whole, such as a gradient: the sum over all shares."""
    if _ROWS not in jax.sharding.get_abstract_mesh().axis_names:
        return tree
    return jax.tree.map(lambda leaf: _laid_out(leaf, Spec()), tree)


def _laid_out(leaf: jax.Array, spec: Spec) -> jax.Array:
    """Inside a program that is being traced as a constraint, outside as a move."""
    if isinstance(leaf, jax.core.Tracer):
        return jax.lax.with_sharding_constraint(leaf, spec)
    return jax.device_put(leaf, NamedSharding(jax.sharding.get_mesh(), spec))


def _mesh(devices: int, axis: str = _AXIS) -> Mesh:
    return Mesh(np.array(jax.devices()[:devices]), (axis,))
