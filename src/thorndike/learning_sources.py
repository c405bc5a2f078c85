"""What an algorithm may learn from, an environment or a dataset, told from names alone: JAX is not imported."""

import os
from pathlib import Path

from thorndike.algorithms import ALGORITHMS
from thorndike.errors import UserError

DATA = Path("data", "main_data.hdf5")
METADATA = Path("data", "metadata.json")
"""Minari's files below a dataset's folder."""


def is_dataset(place: object) -> bool:
    """Whether a name is that of a folder with a dataset in it."""
    return isinstance(place, str | Path) and os.path.isfile(os.path.join(place, METADATA))


def check_source(algorithm: str, named: object) -> None:
    """Raises ``UserError`` if the algorithm does not learn from a dataset, or from an environment, whichever is named."""
    kind = "dataset" if is_dataset(named) else "environment"
    if kind in ALGORITHMS[algorithm].learns_from:
        return
    if kind == "dataset":
        others = ", ".join(name for name, entry in ALGORITHMS.items() if kind in entry.learns_from)
        raise UserError(f"{algorithm} learns from an environment, and {named} is a dataset; those that learn from one: {others}")
    raise UserError(f"{algorithm} learns from a dataset, and {named} is none: make one (thorndike record RUN), and give its folder")
