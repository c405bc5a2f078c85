"""The files of a run that trains a policy, beside ``run.json``: the log, and checkpoints from which it goes on bit for bit."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, cast

from jaxtyping import PyTree

from thorndike.language.over_optimisation import Watch
from thorndike.training.checkpoints import newest
from thorndike.training.json_files import NUMBER, SECONDS, Json, as_bytes, check_fields, optional, parse_object, whole
from thorndike.training.run_directory import append_lines, checkpoints, truncate_lines, write_json
from thorndike.training.sealed_folders import NewFolder, SealedFolder, discard
from thorndike.training.tensorboard import EventWriter
from thorndike.training.tree_files import read_tree, write_tree

_PROGRESS, _STATE, _ADAPTER, _KEPT = "progress.json", "state", "adapter", 2


class Progress(NamedTuple):
    """Where a run stands."""

    iteration: int
    watch: Watch
    wall_s: float


def set_outcome(run: Path, content: Mapping[str, object]) -> None:
    """Write how a run ended into ``outcome.json``."""
    write_json(run / "outcome.json", content)


def save_progress(run: Path, tree: PyTree, progress: Progress, adapter: PyTree | None = None) -> None:
    """A checkpoint, with the ``adapter`` of the policy that is kept if there is one; the two newest are kept."""
    folder = run / "checkpoints"
    folder.mkdir(exist_ok=True)
    new = NewFolder(folder / "partial")
    write_tree(tree, new, _STATE)
    if adapter is not None:
        write_tree(adapter, new, _ADAPTER)
    new.write(_PROGRESS, as_bytes({"iteration": progress.iteration, "watch": progress.watch._asdict(), "wall_s": progress.wall_s}))
    new.publish(folder / str(progress.iteration))
    for path in checkpoints(run)[:-_KEPT]:
        discard(path)


def load_progress(run: Path, like: PyTree, adapter: PyTree | None = None) -> tuple[PyTree, Progress, PyTree | None]:
    """The newest intact checkpoint, or where there is none ``like`` and ``adapter`` themselves; later lines of the log are dropped.

    The adapter is None where the checkpoint is of a version that kept none.

    Raises ``UserError`` if there are some, and all are damaged.
    """
    if not checkpoints(run):
        truncate_lines(run / "metrics.jsonl", 0)
        return like, Progress(0, Watch(), 0.0), adapter

    def read(folder: SealedFolder) -> tuple[PyTree, Progress, PyTree | None]:
        kept = None if adapter is None or f"{_ADAPTER}.safetensors" not in folder else read_tree(adapter, folder, _ADAPTER)
        return read_tree(like, folder, _STATE), _read_progress(folder), kept

    tree, progress, kept = newest(run, read)
    truncate_lines(run / "metrics.jsonl", progress.iteration)
    return tree, progress, kept


class Log:
    """Appends a line an iteration to ``metrics.jsonl``, and the same to TensorBoard's file."""

    def __init__(self, run: Path) -> None:
        """Start a further event file in the run's directory."""
        self._path = run / "metrics.jsonl"
        self._events = EventWriter(run)

    def write(self, step: int, wall_s: float, values: Mapping[str, float]) -> None:
        """Log an iteration."""
        append_lines(self._path, [{"steps": step, "wall_s": wall_s, **{name: [value] for name, value in values.items()}}])
        for name, value in values.items():
            self._events.scalar(name, value, step)
        self._events.flush()

    def close(self) -> None:
        """Finish the event file."""
        self._events.close()


def _read_progress(folder: SealedFolder) -> Progress:
    where = folder.path / _PROGRESS
    content = parse_object(folder.read(_PROGRESS), where)
    check_fields(content, {"iteration": whole(0), "wall_s": SECONDS}, where)
    watch = cast(Json, content.get("watch") or {})
    check_fields(watch, {name: optional(NUMBER) for name in Watch._fields}, where)
    numbers = {name: cast(float | None, watch[name]) for name in Watch._fields}
    return Progress(cast(int, content["iteration"]), Watch(**numbers), cast(float, content["wall_s"]))
