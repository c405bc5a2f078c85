"""Settings per environment, kept as TOML beside the code: ``presets/<algorithm>.toml``. ``result`` says what they were measured to give.

A name may be a pattern such as ``ALE/*``, for environments without an entry of their own.
"""

import tomllib
from fnmatch import fnmatchcase
from importlib import resources
from typing import NamedTuple

from thorndike.errors import UserError

_PARTS = {"steps", "num_envs", "settings", "wrappers", "result", "max_episode_steps", "env_kwargs"}


class Preset(NamedTuple):
    """What a preset sets; ``None`` or empty where it says nothing."""

    name: str
    steps: int | None
    num_envs: int | None
    settings: dict[str, object]
    wrappers: tuple[dict[str, object], ...]
    env_kwargs: dict[str, object]


EMPTY = Preset("defaults", None, None, {}, (), {})


def load_presets(algorithm: str) -> dict[str, dict[str, Preset]]:
    """Every preset of an algorithm: environment -> name -> preset; the one that is used unasked is called ``default``."""
    file = resources.files("thorndike") / "presets" / f"{algorithm}.toml"
    if not file.is_file():
        return {}
    content = tomllib.loads(file.read_text(encoding="utf-8"))
    return {environment: _variants(entry) for environment, entry in content.items()}


def find_preset(algorithm: str, environment: str, name: str | None = None) -> Preset:
    """The preset ``name`` for an environment, or its default one; without a name and without presets, an empty one.

    ``name="none"`` asks for the algorithm's defaults. Raises ``UserError`` for a name that does not exist.
    """
    if name == "none":
        return EMPTY
    variants = _variants_for(environment, load_presets(algorithm))
    if name is None:
        return variants.get("default", EMPTY)
    if name not in variants:
        known = ", ".join(sorted(variants)) or "there are none"
        raise UserError(f"no preset {name!r} of {algorithm} for {environment}; known: {known}")
    return variants[name]


def _variants_for(environment: str, presets: dict[str, dict[str, Preset]]) -> dict[str, Preset]:
    if environment in presets:
        return presets[environment]
    return next((variants for pattern, variants in presets.items() if fnmatchcase(environment, pattern)), {})


def _variants(entry: dict) -> dict[str, Preset]:
    named = {key: _preset(key, value) for key, value in entry.items() if key not in _PARTS and isinstance(value, dict)}
    own = {key: value for key, value in entry.items() if key in _PARTS}
    return {"default": _preset("default", own), **named} if own else named


def _preset(name: str, entry: dict) -> Preset:
    settings, env_kwargs = dict(entry.get("settings", {})), dict(entry.get("env_kwargs", {}))
    return Preset(name, entry.get("steps"), entry.get("num_envs"), settings, tuple(entry.get("wrappers", ())), env_kwargs)
