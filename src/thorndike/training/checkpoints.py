"""Checkpoints: the whole carry of a run, written so that whatever happens the newest complete one can be gone on from.

The two newest are kept, or as many as are asked for. These two share no file with each other, so that damage to one never reaches the
other: a block of a replay buffer that has not changed is shared with the checkpoint *before* the newest, which, unless more are asked for,
is removed once the new one is in its place.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import jax
from jaxtyping import PyTree

from thorndike.dependence import looked_at
from thorndike.errors import UserError
from thorndike.training.host_source import HostSource
from thorndike.training.json_files import OBJECT, SECONDS, Json, as_bytes, check_fields, parse_object, whole
from thorndike.training.notices import notice
from thorndike.training.run_directory import checkpoints, truncate_lines
from thorndike.training.runner import Runner
from thorndike.training.sealed_folders import Damaged, NewFolder, SealedFolder, discard
from thorndike.training.segment import Carry
from thorndike.training.tree_files import read_tree, write_tree
from thorndike.types import Algorithm

STATE = "state"
_PROGRESS = "progress.json"
KEPT = 2
"""Checkpoints, where nobody asks for more."""
_OURS = re.compile(r"(\d+|partial)(\.old|\.gone|\.damaged)*")

Content = TypeVar("Content")


class Changed(UserError):
    """``run.json`` does not say what it said when the checkpoints were made."""


class Progressed(NamedTuple):
    """Where a run stands."""

    iteration: int
    wall_s: float
    cpu_s: float


START = Progressed(0, 0.0, 0.0)


def save_checkpoint(
    run: Path,
    carry: Carry,
    source: PyTree,
    progressed: Progressed,
    steps_per_iteration: int,
    request: Mapping[str, object] | None = None,
    keep: int = KEPT,
) -> None:
    """Write the whole carry (of a host source, only what can be restored), what was requested of the run, and where it stands.

    The ``keep`` newest checkpoints stay. Raises ``OSError`` if it cannot be written; the checkpoints there are stay as they are.
    """
    folder = run / "checkpoints"
    folder.mkdir(exist_ok=True)
    known = checkpoints(run)
    new = NewFolder(folder / "partial")
    write_tree(restorable(carry, source), new, STATE, blocks=True, donor=known[-KEPT] if len(known) >= KEPT else None)
    new.write(_PROGRESS, as_bytes({**progressed._asdict(), "request": dict(request or {})}))
    new.publish(folder / str(progressed.iteration * steps_per_iteration))
    kept = checkpoints(run)[-keep:]
    for path in folder.iterdir():
        if path not in kept and _OURS.fullmatch(path.name):
            discard(path)


def restore(run: Path, runner: Runner, source: PyTree, request: Mapping[str, object] | None = None) -> tuple[Carry, Progressed]:
    """``load_checkpoint``, to go on from there: later lines of the log are dropped."""
    carry, progressed = load_checkpoint(run, runner, source, request)
    truncate_lines(run / "metrics.jsonl", progressed.iteration * runner.steps_per_iteration)
    return carry, progressed


def load_checkpoint(run: Path, runner: Runner, source: PyTree, request: Mapping[str, object] | None = None) -> tuple[Carry, Progressed]:
    """The carry of the newest checkpoint that is as it was written, and where it stands.

    Those that are damaged are put aside, and a notice tells of them. Raises ``UserError`` if there is no other, or ``request`` is not what
    it was made for.
    """
    fresh = runner.init()

    def read(folder: SealedFolder) -> tuple[PyTree, Progressed]:
        progressed, made_for = _read_progress(folder)
        _check_request(made_for, request or {}, run)
        if str(progressed.iteration * runner.steps_per_iteration) != folder.path.name:
            raise Damaged(f"{folder.path} is damaged: it holds iteration {progressed.iteration}, which is another step")
        return read_tree(restorable(fresh, source), folder, STATE), progressed

    stored, progressed = newest(run, read)
    if not isinstance(source, HostSource):
        return fresh._replace(learner=stored[0], source=stored[1]), progressed
    return fresh._replace(learner=stored[0], source=source.restart(stored[1], progressed.iteration)), progressed


def newest(run: Path, read: Callable[[SealedFolder], Content]) -> Content:
    """What ``read`` finds in the newest checkpoint that it can read; those that it cannot are put aside once one was found.

    Raises ``UserError`` if there is none.
    """
    refused: list[tuple[Path, UserError]] = []
    for path in reversed(checkpoints(run)):
        try:
            found = read(SealedFolder(path))
        except Changed:
            raise
        except UserError as error:
            refused.append((path, error))
            continue
        for bad, reason in refused:
            notice(f"{reason}; going on from the checkpoint before it, of step {path.name}")
            bad.rename(bad.with_name(bad.name + ".damaged"))
        return found
    why = f": {refused[0][1]}" if refused else "; train again"
    raise UserError(f"{run} has no intact checkpoint to go on from{why}")


def _read_progress(folder: SealedFolder) -> tuple[Progressed, Json]:
    """Where a checkpoint stands, and the request it was made for (empty in checkpoints of older versions). Raises ``UserError``."""
    where = folder.path / _PROGRESS
    content = parse_object(folder.read(_PROGRESS), where)
    check_fields(content, {"iteration": whole(0), "wall_s": SECONDS, "cpu_s": SECONDS}, where)
    made_for = content.get("request", {})
    check_fields({"request": made_for}, {"request": OBJECT}, where)
    progressed = Progressed(cast(int, content["iteration"]), cast(float, content["wall_s"]), cast(float, content["cpu_s"]))
    return progressed, cast(Json, made_for)


def read_actors(
    folder: Path, algorithm: Algorithm, statistics: Mapping[int, PyTree], seeds: int, compiled: bool
) -> tuple[PyTree, tuple[PyTree, ...]]:
    """Actors ``[S, ...]`` of a checkpoint and the statistics of its wrappers. Replay and other large arrays that do not act are not read.

    ``statistics`` are the shapes of one seed's, by the wrapper's place in the chain. Raises ``UserError``.
    """
    shapes, structure = jax.tree.flatten(jax.eval_shape(algorithm.init, jax.random.key(0)))
    acts = looked_at(algorithm.actor, jax.tree.unflatten(structure, shapes))
    part = jax.tree.unflatten(structure, [_of_seeds(leaf, seeds) if used else None for leaf, used in zip(shapes, acts, strict=True)])
    held = {str(place): jax.tree.map(lambda leaf: _of_seeds(leaf, seeds), tree) for place, tree in statistics.items()}
    learner, learnt = read_tree((part, {"statistics": held} if compiled else held), SealedFolder(folder), STATE, part=True)

    def actor(part: PyTree) -> PyTree:
        whole = jax.tree.unflatten(structure, shapes)
        return algorithm.actor(jax.tree.map(lambda shape, leaf: shape if leaf is None else leaf, whole, part))

    found = learnt["statistics"] if compiled else learnt
    return jax.vmap(actor)(learner), tuple(found[str(place)] for place in statistics)


def _of_seeds(leaf: jax.ShapeDtypeStruct, seeds: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((seeds, *leaf.shape), leaf.dtype)


def restorable(carry: Carry, source: PyTree) -> tuple[PyTree, PyTree]:
    """The part of a carry that a checkpoint holds."""
    return carry.learner, carry.source.statistics if isinstance(source, HostSource) else carry.source


def _check_request(before: Mapping[str, object], now: Mapping[str, object], run: Path) -> None:
    """Going on with another seed, say, would give a run that nobody could ever make again. The number of steps may change."""
    for name in before:
        if name in now and name != "steps" and _text(before[name]) != _text(now[name]):
            raise Changed(f"{run}/run.json was changed: its checkpoints were made with {name} = {_text(before[name])}; put that back")


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True)
