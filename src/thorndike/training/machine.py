"""What a run's bits depend on beside its seed: versions, processors, XLA's options, and what arithmetic gives here."""

import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path

from thorndike.startup import without_device_count
from thorndike.training.json_files import Json

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium", "thorndike")
"""Those whose version may change the last bits of a run."""
_VECTORS = ("sse", "avx", "fma", "f16c", "amx", "asimd", "sve", "neon")


def machine() -> Json:
    """The processor, what it can do on vectors, XLA's options, and a hash of what a small program computes here. Starts JAX."""
    flags = without_device_count(os.environ.get("XLA_FLAGS", ""))
    return {"processor": _processor(), "features": _features(), "xla_flags": flags, "self_test": self_test()}


def self_test() -> str:
    """Sixteen hexadecimal digits that follow from the bits of a small compiled program (measured: 15 ms, once it is in XLA's cache)."""
    import jax
    import numpy as np
    from jax import lax

    def program(x: jax.Array) -> jax.Array:
        y = lax.tanh(lax.dot(x, x))
        return lax.dot(lax.exp(y), lax.log1p(lax.abs(y)))

    result = jax.jit(program)(np.linspace(-1, 1, 4096, dtype=np.float32).reshape(64, 64))
    return hashlib.sha256(np.asarray(result).tobytes()).hexdigest()[:16]


def differences(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """What may make bits differ here from those of a run with the facts `before`; what was not recorded then is not compared."""
    versions, versions_now = _mapping(before.get("versions")), _mapping(now.get("versions"))
    machine, machine_now = _mapping(before.get("machine")), _mapping(now.get("machine"))
    compared = [
        *((package, versions.get(package), versions_now.get(package)) for package in _PACKAGES),
        ("device", before.get("device"), now.get("device")),
        ("NPROC", before.get("processors"), now.get("processors")),
        ("processor", machine.get("processor"), machine_now.get("processor")),
        ("XLA_FLAGS", machine.get("xla_flags"), machine_now.get("xla_flags")),
    ]
    found = [f"{name} {here} in place of {there}" for name, there, here in compared if there not in (None, here)]
    found += _unlike(machine.get("features"), machine_now.get("features"))
    if machine.get("self_test") not in (None, machine_now.get("self_test")):
        found.append("a test computation gives other bits")
    return found


def _unlike(before: object, now: object) -> list[str]:
    """In words, which of a processor's features there were and are not, or the other way round; nothing if they were not recorded."""
    if before in (None, now):
        return []
    there, here = set(str(before).split()), set(str(now).split())
    lacking, further = " ".join(sorted(there - here)), " ".join(sorted(here - there))
    parts = [f"lacks {lacking}"] * bool(lacking) + [f"also has {further}"] * bool(further)
    return [f"the processor {' and '.join(parts)}"]


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _processor() -> str:
    """The processor's own name, where the system tells it."""
    return _told("model name") or platform.processor() or platform.machine()


def _features() -> str:
    """The sets of vector instructions that XLA may compile for: of two processors with one name, one may have fewer."""
    words = (_told("flags") or _told("Features") or "").split()
    return " ".join(sorted(word for word in words if word.startswith(_VECTORS)))


def _told(name: str) -> str | None:
    """What Linux says of the first processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), None)
