"""``thorndike info``: what runs here, for a bug report and for choosing a device."""

import os
import platform
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from thorndike.cli.answer import Answer
from thorndike.cli.parser import Parser

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium", "safetensors")
OPTIONAL = {
    "ale-py": "atari",
    "envpool": "pool",
    "mujoco": "mujoco",
    "box2d": "box2d",
    "matplotlib": "plot",
    "imageio": "video",
    "imageio-ffmpeg": "video",
    "pygame-ce": "video",
    "nicegui": "web",
    "tokenizers": "language",
}
"""Package -> the extra that brings it."""


def run(words: Sequence[str]) -> Answer:
    """Versions, processors, devices and optional packages."""
    Parser("info", "Show versions, devices and optional packages.").parse(words)
    data = {
        "thorndike": _version("thorndike"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "devices": _devices(),
        "packages": {name: _version(name) for name in PACKAGES},
        "optional": {name: _version(name) for name in OPTIONAL},
    }
    lines = [
        f"thorndike {data['thorndike']}, Python {data['python']} ({sys.executable})",
        f"{data['platform']}, {data['cores']} cores, devices: {', '.join(_devices())}",
        ", ".join(f"{name} {_version(name)}" for name in PACKAGES),
        *(f"{name:15} {_version(name) or f'not installed: pip install thorndike[{extra}]'}" for name, extra in OPTIONAL.items()),
    ]
    return Answer(data, "\n".join(lines))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _devices() -> list[str]:
    if find_spec("jax") is None:
        return []
    import jax

    return [f"{device.platform}:{device.id} {device.device_kind}" for device in jax.devices()]
