"""For every test: shapes and dtypes are checked as annotated, and broadcasting between ranks is an error."""

import os
from pathlib import Path

# Before JAX, pygame and MuJoCo are imported: no display, no greeting, no device but the processor unless one is asked for.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# On a CPU the bits depend on the number of processors; one, as small programs are run on, also compiles what the cache can hold for all.
os.environ.setdefault("NPROC", "1")
# What is compiled stays in the checkout, so that the second `make test` is several times faster.
os.environ.setdefault("THORNDIKE_CACHE", str(Path(__file__).parents[1] / ".cache"))

from thorndike import startup

startup.prepare()

import signal
from collections.abc import Iterator

import jax
import pytest
from jaxtyping import install_import_hook

# A shell starts what runs in its background deaf to Ctrl-C, and children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook(["thorndike.functional", "thorndike.networks", "thorndike.replay"], "beartype.beartype")


@pytest.fixture(scope="module")
def quick_compile() -> Iterator[None]:
    """XLA's optimisations off: for programs that run for seconds and would compile for longer (measured: a half of the time)."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
