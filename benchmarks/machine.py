"""Facts about the machine and the software that belong to every figure."""

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

PACKAGES = (
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "gymnasium",
    "numpy",
    "torch",
    "stable_baselines3",
    "sbx_rl",
    "rejax",
    "gymnax",
    "transformers",
    "trl",
)


def processor() -> str:
    """The processor's name as Linux tells it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def memory_gib() -> float:
    """Physical memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def commit(root: Path) -> str:
    """The commit of the working tree, with ``+`` if it holds changes outside what a benchmark writes; ``unknown`` outside git."""
    told = subprocess.run(["git", "-C", str(root), "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=False)
    if told.returncode != 0:
        return "unknown"
    changes = ["git", "-C", str(root), "status", "--porcelain", "--", "src", "benchmarks/*.py", "benchmarks/peers"]
    changed = subprocess.run(changes, capture_output=True, text=True, check=False).stdout.strip()
    return told.stdout.strip() + ("+" if changed else "")


def origin() -> dict[str, str]:
    """What every row of results says of itself: the command line, and the commit."""
    return {
        "command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        "commit": commit(Path(__file__).parents[1]),
    }


def keep_row(results: Path, name: str, row: Mapping[str, object]) -> None:
    """Put a row into a file of results; the others stay as they are."""
    rows = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
    results.write_text(json.dumps({**rows, name: row}, indent=1) + "\n", encoding="utf-8")


def versions(python: Path) -> dict[str, str]:
    """Versions of the packages that matter, in the virtual environment of ``python``; empty if it is not there."""
    if not python.exists():
        return {}
    code = (
        "import json, sys, importlib.metadata as m\n"
        "have = {d.metadata['Name'].lower().replace('-', '_'): d.version for d in m.distributions()}\n"
        f"print(json.dumps({{'python': sys.version.split()[0], **{{n: have[n] for n in {PACKAGES!r} if n in have}}}}))"
    )
    told = subprocess.run([str(python), "-c", code], capture_output=True, text=True, check=True)
    return json.loads(told.stdout)


def facts(root: Path, peers: Path) -> dict[str, object]:
    """Machine, commit and versions, as they go into every results file."""
    return {
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "memory_gib": round(memory_gib(), 1),
            "system": platform.platform(),
            "load": list(os.getloadavg()),
        },
        "commit": commit(root),
        "versions": {"thorndike": versions(root / ".venv" / "bin" / "python"), "peers": versions(peers / "bin" / "python")},
    }
