"""Several devices: each trains its share of the seeds. What a seed computes does not depend on how many there are.

A CPU counts as several devices too, one a core: seeds that took turns on one core then train at the same time (startup.py).
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import PyTree

_AXIS = "seeds"


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


def _mesh(devices: int) -> Mesh:
    return Mesh(np.array(jax.devices()[:devices]), (_AXIS,))
