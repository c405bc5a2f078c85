"""What must be decided before JAX starts: processors, XLA's options, the compilation cache, the device. Only environment variables are set."""

import os
import sys
from pathlib import Path

_SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536"
"""Lets XLA turn a loop over a table into one function: measured 10x faster tabular learning. It changes nothing elsewhere."""


def cache_directory() -> Path:
    """Where compiled programs are kept: ``$THORNDIKE_CACHE``, else ``thorndike`` in the user's cache directory."""
    chosen = os.environ.get("THORNDIKE_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thorndike"


def prepare(processors: int | None = None, device: str = "auto") -> None:
    """Set what is not set yet. It has no effect on a JAX that has already started.

    ``processors`` pins XLA's threads: small programs run faster, and exactly repeatably, on one.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_SMALL_LOOPS}".strip()
    if processors is not None:
        os.environ.setdefault("NPROC", str(processors))
    if device != "auto":
        os.environ["JAX_PLATFORMS"] = {"gpu": "cuda"}.get(device, device)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_directory() / "xla"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    # Headless drawing of Gymnasium's classic environments.
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
