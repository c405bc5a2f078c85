"""Rates that change over a run, written as a number or as text: ``3e-4``, ``"linear(3e-4, 0)"``, ``"linear(1.0, 0.05, 0.1)"``."""

import re
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.errors import UserError
from thorndike.types import Number

Schedule: TypeAlias = Callable[[Array], Array]
"""Progress in ``[0, 1]`` to a value: how a rate changes over a run."""

_TEXT = re.compile(r"(?P<kind>linear|cosine|exponential)\((?P<numbers>[^()]*)\)")


class Rate(NamedTuple):
    """A rate that moves from ``start`` to ``end`` over the first ``fraction`` of a run. Its numbers may be traced."""

    kind: str
    """``linear``, ``cosine`` or ``exponential``."""
    start: Number
    end: Number
    fraction: Number


def schedule(value: Number | str | Rate) -> Schedule:
    """Turn a rate into a function of progress in ``[0, 1]``.

    ``linear(start, end, fraction=1)`` moves from ``start`` to ``end`` over the first ``fraction`` of the run and stays there; ``cosine``
    and ``exponential`` take the same numbers. ``lin_3e-4`` (RL Zoo's way) is ``linear(3e-4, 0)``. Raises ``UserError`` for other text.
    """
    rate = parse_rate(value) if isinstance(value, str) else value
    if isinstance(rate, Rate):
        return _moving(rate)
    return lambda progress: jnp.asarray(rate, jnp.float32)


def parse_rate(text: str) -> float | Rate:
    """The numbers of a rate written as text: one, or those of a schedule. Raises ``UserError`` for text that is neither."""
    if text.startswith("lin_"):
        return parse_rate(f"linear({text[4:]}, 0)")
    match = _TEXT.fullmatch(text.strip())
    if match is None:
        return _constant(text)
    try:
        numbers = [float(number) for number in match["numbers"].split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise UserError(f"a schedule takes two or three numbers, as in linear(3e-4, 0, 0.5); got {text!r}")
    start, end, fraction = (*numbers, 1.0)[:3]
    if not 0.0 < fraction <= 1.0:
        raise UserError(f"a schedule's fraction of the run is in (0, 1]; got {fraction}")
    if match["kind"] == "exponential" and min(start, end) <= 0:
        raise UserError(f"an exponential schedule needs positive ends; got {start} and {end}")
    return Rate(match["kind"], start, end, fraction)


def _constant(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UserError(
            f"a rate is a number or a schedule such as linear(3e-4, 0), cosine(...) or exponential(...); got {text!r}"
        ) from None


def _moving(rate: Rate) -> Schedule:
    kind, start, end, fraction = rate

    def at(progress: Float[Array, ""]) -> Float[Array, ""]:
        done = jnp.clip(progress / fraction, 0.0, 1.0)
        if kind == "exponential":
            return start * (end / start) ** done
        if kind == "cosine":
            return end + (start - end) * 0.5 * (1.0 + jnp.cos(jnp.pi * done))
        return start + (end - start) * done

    return at
