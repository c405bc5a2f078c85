"""Which number was the first that is none: the iteration is found again from the last checkpoint, and its batch written down.

While training, nothing is checked but the metrics, once a segment: a NaN or infinity anywhere reaches them, and learners do not apply
an update whose loss or gradient is not finite. Since a run can be repeated bit for bit from its last checkpoint, the place is found
afterwards.
"""

import json
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from safetensors.numpy import save_file

from thorndike.training.runner import Runner
from thorndike.training.segment import Carry
from thorndike.training.tree_files import named_arrays
from thorndike.types import Rollout


class Culprit(NamedTuple):
    """The first number of a batch that is not finite."""

    what: str
    """``observation``, ``action``, ``reward`` or ``next observation``, with the entry of a Dict."""
    value: float
    seed: int
    environment: int
    row: int
    """The step within the rollout."""

    def __str__(self) -> str:
        return f"the {self.what} of environment {self.environment} of seed {self.seed} is {self.value}"


def first_culprit(rollout: Rollout) -> Culprit | None:
    """The first non-finite number of a rollout ``[S, T, B, ...]``: by step, and within a step in the order in which they come about."""
    parts = (
        ("observation", rollout.obs),
        ("action", rollout.action),
        ("reward", rollout.step.reward),
        ("next observation", rollout.step.next_obs),
    )
    found: list[tuple[int, int, Culprit]] = []
    for order, (name, tree) in enumerate(parts):
        for path, leaf in jax.tree.leaves_with_path(tree):
            array = np.asarray(leaf)
            if not np.issubdtype(array.dtype, np.floating):
                continue
            wrong = np.argwhere(~np.isfinite(array))
            if len(wrong):
                place = wrong[np.argmin(wrong[:, 1])]
                seed, row, environment = (int(i) for i in place[:3])
                found.append((row, order, Culprit(name + jax.tree_util.keystr(path), float(array[tuple(place)]), seed, environment, row)))
    return min(found, key=lambda each: each[:2])[2] if found else None


def locate(run: Path, runner: Runner, carry: Carry, first: int, until: int) -> str | None:
    """Go through iterations ``first`` to ``until`` again, one by one; what is wrong in the first bad one, whose batch is written down.

    ``carry`` is that of iteration ``first``, and consumed. None if all is well this time, or the runner cannot inspect.
    """
    if runner.inspect is None:
        return None
    for iteration in range(first, until):
        rollout = runner.inspect(carry, iteration)
        culprit = first_culprit(rollout)
        if culprit is not None:
            step = iteration * runner.steps_per_iteration + culprit.row * (runner.steps_per_iteration // rollout.step.reward.shape[1])
            return f"{culprit} at step {step:,}; {_dump(run, rollout, iteration, str(culprit))}"
        carry, report = runner.advance(carry, iteration, 1)
        for name, values in report.metrics.items():
            wrong = np.flatnonzero(~np.isfinite(np.asarray(values)))
            if len(wrong):
                step = (iteration + 1) * runner.steps_per_iteration
                what = f"{name} of seed {wrong[0]} is {np.asarray(values)[wrong[0]]}, though its batch is finite,"
                return f"{what} at step {step:,}; {_dump(run, rollout, iteration, what)}"
    return None


def _dump(run: Path, rollout: Rollout, iteration: int, what: str) -> str:
    folder = run / "faults"
    folder.mkdir(exist_ok=True)
    file = folder / f"iteration-{iteration}.safetensors"
    save_file(named_arrays(rollout), file)
    file.with_suffix(".json").write_text(json.dumps({"iteration": iteration, "what": what}), encoding="utf-8")
    return f"the batch is in {file}"
