"""The wrappers that can be built from words or from a file, and their settings: known without importing them, for that brings JAX."""

import ast
import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType, NoneType
from typing import TYPE_CHECKING

from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

if TYPE_CHECKING:
    from thorndike.types import Wrapper

_WRAPPERS, _NOVELTY = "thorndike.environments.wrappers", "thorndike.environments.novelty"
MODULES: Mapping[str, str] = MappingProxyType(
    {
        "centre_reward": _WRAPPERS,
        "clip_reward": _WRAPPERS,
        "count_bonus": _NOVELTY,
        "discretise": _WRAPPERS,
        "end_at_cost": _WRAPPERS,
        "frame_stack": _WRAPPERS,
        "learned_reward": "thorndike.environments.learned_reward",
        "normalize_observation": _WRAPPERS,
        "normalize_reward": _WRAPPERS,
        "random_network_distillation": _NOVELTY,
        "select_observation": _WRAPPERS,
    }
)
"""Name -> the module of the function of that name."""
LEARNT = "learned_reward"
"""Comes with a folder that it was learnt in, not from words alone."""
_KINDS: Mapping[str, tuple[tuple[type, ...], str]] = MappingProxyType(
    {
        "int": ((int,), "a whole number"),
        "float": ((int, float), "a number"),
        "tuple[int, ...]": ((tuple, list), "a list such as (64, 64)"),
        "Sequence[int]": ((tuple, list), "a list such as [0, 2]"),
        "Sequence[float]": ((tuple, list), "a list such as [0.5, 2.0]"),
        "int | Sequence[int]": ((int, tuple, list), "a whole number or a list such as [6, 8]"),
        "Bound": ((int, float, tuple, list, NoneType), "a number, a list such as [0.5, 2.0], or None"),
    }
)


def builder(name: str) -> "Callable[..., Wrapper]":
    """The function that builds a wrapper. Raises UserError for a name that has none."""
    if name not in MODULES:
        raise UserError(f"no wrapper {name!r} can be built from settings{did_you_mean(name, MODULES)}")
    return getattr(importlib.import_module(MODULES[name]), name)


def parse_wrapper(text: str) -> dict[str, object]:
    """``"count_bonus(coefficient=0.1)"`` as the settings that ``wrappers.from_settings`` takes.

    Raises UserError for text of another form, a wrapper or a setting that does not exist, one that is missing or of another type.
    """
    name, values = _call(text)
    if name == LEARNT:
        raise UserError(f"--wrap {text}: a learnt reward is given by the folder that it was learnt in: --reward DIR")
    if name not in MODULES:
        offered = [each for each in MODULES if each != LEARNT]
        raise UserError(f"--wrap {text}: there is no wrapper '{name}'{did_you_mean(name, offered)}; one of {', '.join(offered)}")
    known, required = _signature(name)
    for key, value in values.items():
        if key not in known:
            raise UserError(f"--wrap {text}: {name} has no setting '{key}'{did_you_mean(key, known)}")
        types, words = _KINDS.get(known[key], ((object,), ""))
        if not isinstance(value, types) or (types != (object,) and isinstance(value, bool)):
            raise UserError(f"--wrap {text}: {key} must be {words}, not {value!r}")
    missing = [key for key in required if key not in values]
    if missing:
        raise UserError(f"--wrap {text}: {name} needs {' and '.join(missing)}, as in {name}({missing[0]}=...)")
    return {"name": name, **values}


def _call(text: str) -> tuple[str, dict[str, object]]:
    try:
        return _parts(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        # All that Python's reader raises for what is not of this form.
        example = "for example --wrap 'count_bonus(coefficient=0.1)'"
        raise UserError(f"--wrap {' '.join(text.split())}: expected NAME or NAME(SETTING=VALUE, ...), {example}") from error


def _parts(call: ast.expr) -> tuple[str, dict[str, object]]:
    match call:
        case ast.Name(id=name):
            return name, {}
        case ast.Call(func=ast.Name(id=name), args=[], keywords=keywords) if all(each.arg for each in keywords):
            return name, {str(each.arg): ast.literal_eval(each.value) for each in keywords}
    raise ValueError("another form")


def _signature(name: str) -> tuple[dict[str, str], list[str]]:
    """The settings of a wrapper with their types as written, and those without a default, from the text of its file."""
    path = Path(__file__).parent / f"{MODULES[name].rpartition('.')[2]}.py"
    tree = ast.parse(path.read_text(encoding="utf-8"))
    declared = next(node.args for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name)
    known = {each.arg: ast.unparse(each.annotation) if each.annotation else "" for each in declared.args}
    return known, list(known)[: len(known) - len(declared.defaults)]
