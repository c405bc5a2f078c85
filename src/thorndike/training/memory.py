"""How much memory a learner will take, and how much there is: said before it is taken."""

import math
from pathlib import Path

import jax

from thorndike.errors import UserError
from thorndike.training.notices import notice
from thorndike.types import Algorithm

WORTH_SAYING = 100e6
"""Bytes below which nothing is printed."""
_UNLIMITED = 2**60
_CGROUPS = Path("/sys/fs/cgroup")


def check_memory(name: str, algorithm: Algorithm, seeds: int, buffer_size: int | None, twice: bool = False) -> int:
    """Bytes that the learners of all seeds will take; printed if they are many. Raises ``UserError`` where they do not fit.

    ``twice``: whether two copies are there at times.
    """
    state = jax.eval_shape(algorithm.init, jax.random.key(0))
    needed = seeds * sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) * (2 if twice else 1)
    free = available_memory()
    if free is not None and needed > free:
        raise UserError(
            f"{name}: {_of(seeds)} needs {gigabytes(needed)}, {gigabytes(free)} are available; {_advice(buffer_size, free / needed, seeds)}"
        )
    if needed >= WORTH_SAYING:
        beside = "" if free is None else f" of {gigabytes(free)} available"
        notice(f"{name}: {_of(seeds)} takes {gigabytes(needed)}{beside}")
    return needed


def available_memory() -> int | None:
    """Bytes that may still be taken on the device that computes; None where nobody says."""
    if jax.default_backend() != "cpu":
        statistics = jax.devices()[0].memory_stats() or {}
        return statistics["bytes_limit"] - statistics["bytes_in_use"] if "bytes_limit" in statistics else None
    known = [bytes for bytes in (_free_of_machine(), _free_of_group()) if bytes is not None]
    return min(known, default=None)


def gigabytes(count: float) -> str:
    """``7.52 GB``."""
    return f"{count / 1e9:.3g} GB"


def _of(seeds: int) -> str:
    return "the learner with its replay" if seeds == 1 else f"{seeds} learners with their replays"


def _advice(buffer_size: int | None, share: float, seeds: int) -> str:
    fits = "" if buffer_size is None else f"set buffer_size to {max(1, int(0.9 * share * buffer_size)):,} or less"
    fewer = "train fewer seeds at a time" if seeds > 1 else ""
    return " or ".join(part for part in (fits, fewer) if part) or "use a machine with more memory"


def _free_of_machine(path: Path = Path("/proc/meminfo")) -> int | None:
    """What Linux could give without swapping."""
    for line in _text(path).splitlines():
        name, _, value = line.partition(":")
        if name == "MemAvailable":
            return int(value.split()[0]) * 1024
    return None


def _free_of_group(root: Path = _CGROUPS, membership: Path = Path("/proc/self/cgroup")) -> int | None:
    """What is left of the tightest limit of this process's control groups (version 2, then 1)."""
    left = []
    for line in _text(membership).splitlines():
        _, controllers, place = line.split(":", 2)
        second = controllers == ""
        if not second and "memory" not in controllers.split(","):
            continue
        top = root if second else root / "memory"
        names = ("memory.max", "memory.current", "inactive_file") if second else (
            "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
        )  # fmt: skip
        group = top / place.lstrip("/")
        left += [found for folder in (group, *group.parents) if folder.is_relative_to(top) and (found := _left(folder, *names)) is not None]
    return min(left, default=None)


def _left(folder: Path, limit: str, usage: str, reclaimable: str) -> int | None:
    most, used = _text(folder / limit).strip(), _text(folder / usage).strip()
    if not most.isdigit() or not used.isdigit() or int(most) >= _UNLIMITED:
        return None
    facts = dict(line.split(maxsplit=1) for line in _text(folder / "memory.stat").splitlines())
    return int(most) - int(used) + int(facts.get(reclaimable, 0))


def _text(path: Path) -> str:
    """A file's text; nothing where it is not there."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
