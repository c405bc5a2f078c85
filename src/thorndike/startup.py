"""What must be decided before JAX starts: processors, XLA's options, the compilation cache, the device, how memory is kept."""

import ctypes
import os
import sys
from importlib.metadata import version
from pathlib import Path

from thorndike.errors import UserError

_SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536"
"""Lets XLA turn a loop over a table into one function: measured 10x faster tabular learning. It changes nothing elsewhere."""

_KEEP = {-8: 1, -4: 0, -1: 2**31 - 1}
"""glibc's ``mallopt``: one arena, no block mapped on its own, nothing handed back to the system at the end of the heap."""

_IN_ORDER = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
_KNOWS_IT = "0.10."
"""The jaxlib that was tried with this option: XLA ends the process over one that it does not know."""

_AS_DEVICES = "--xla_force_host_platform_device_count="


def cache_directory() -> Path:
    """Where compiled programs are kept: ``$THORNDIKE_CACHE``, else ``thorndike`` in the user's cache directory."""
    chosen = os.environ.get("THORNDIKE_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "thorndike"


def prepare() -> None:
    """Set, as environment variables that are read when JAX is imported, what the user has not set."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_SMALL_LOOPS}".strip()
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_directory() / "xla"))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
    # Headless drawing of Gymnasium's classic environments.
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")


def prepare_large_steps() -> None:
    """Make what a language model's steps need of memory cheap, and little; before JAX starts.

    A step asks for hundreds of megabytes at once and frees them. By default glibc maps each such block anew, and the system clears it page
    by page: a third of the CPU time (measured with a million parameters and 4,096 tokens, forward and backward: 363 ms, of which 117 in
    the system; 215 ms with the memory kept). And XLA orders its operations for many threads, so that more is alive at once than need be:
    292 MB of activations against 227, with rematerialisation 270 against 132.
    """
    if sys.platform.startswith("linux"):
        tune = getattr(ctypes.CDLL(None), "mallopt", None)
        if tune is not None:
            for option, value in _KEEP.items():
                tune(option, value)
    flags = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(_KNOWS_IT) and "concurrency_optimized_scheduler" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_IN_ORDER}".strip()


def cores() -> int:
    """The processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def count_cores_as_devices(number: int) -> None:
    """Let the CPU be ``number`` devices. It takes effect where JAX has not chosen its devices yet; a number the user has set stays."""
    flags = os.environ.get("XLA_FLAGS", "")
    if number > 1 and _AS_DEVICES not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_AS_DEVICES}{number}".strip()


def without_device_count(flags: str) -> str:
    """XLA's flags but for the number of devices the CPU counts as, which changes no result."""
    return " ".join(flag for flag in flags.split() if not flag.startswith(_AS_DEVICES))


def device_count(at_most: int | None) -> int:
    """How many devices there are to train on, at most ``at_most``. Raises ``UserError`` if that is less than one."""
    import jax

    if at_most is not None and at_most < 1:
        raise UserError(f"devices={at_most}: training needs one at least; leave it out to use all there are")
    found = jax.device_count()
    return found if at_most is None else min(at_most, found)


def choose_device(device: str, large: bool, processors: int | None = None) -> str:
    """Choose the device, before its first use, and return its platform's name.

    ``auto`` takes the CPU for small programs (they run faster there, and on one processor, exactly repeatably) and JAX's default for
    ``large`` ones. Raises ``UserError`` for a device that is not there. A JAX that has already started keeps what it has.
    """
    import jax

    pinned = processors or (None if large else 1)
    if pinned is not None:
        os.environ.setdefault("NPROC", str(pinned))
    wanted = {"gpu": "cuda", "auto": None if large else "cpu"}.get(device, device)
    if wanted is not None:
        jax.config.update("jax_platforms", wanted)
    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        # The second, without a word, where this build of JAX does not know the platform at all.
        why = (str(error) or f"this build of JAX knows no {wanted}").splitlines()[0]
        raise UserError(f"--device {device}: JAX has no such device here ({why}); use --device cpu") from error
