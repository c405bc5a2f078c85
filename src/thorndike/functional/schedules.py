"""Rates that change over a run, written as a number or as text: ``3e-4``, ``"linear(3e-4, 0)"``, ``"linear(1.0, 0.05, 0.1)"``."""

import re

import jax.numpy as jnp
from jaxtyping import Array, Float

from thorndike.errors import UserError
from thorndike.types import Schedule

_TEXT = re.compile(r"(?P<kind>linear|cosine|exponential)\((?P<numbers>[^()]*)\)")


def schedule(value: float | str) -> Schedule:
    """Turn a rate into a function of progress in ``[0, 1]``.

    ``linear(start, end, fraction=1)`` moves from ``start`` to ``end`` over the first ``fraction`` of the run and stays there; ``cosine``
    and ``exponential`` take the same numbers. ``lin_3e-4`` (RL Zoo's way) is ``linear(3e-4, 0)``. Raises ``UserError`` for other text.
    """
    if not isinstance(value, str):
        return lambda progress: jnp.asarray(value, jnp.float32)
    if value.startswith("lin_"):
        return schedule(f"linear({value[4:]}, 0)")
    match = _TEXT.fullmatch(value.strip())
    if match is None:
        return _constant(value)
    try:
        numbers = [float(number) for number in match["numbers"].split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise UserError(f"a schedule takes two or three numbers, as in linear(3e-4, 0, 0.5); got {value!r}")
    start, end, fraction = (*numbers, 1.0)[:3]
    return _moving(match["kind"], start, end, fraction)


def _constant(text: str) -> Schedule:
    try:
        number = float(text)
    except ValueError:
        raise UserError(
            f"a rate is a number or a schedule such as linear(3e-4, 0), cosine(...) or exponential(...); got {text!r}"
        ) from None
    return schedule(number)


def _moving(kind: str, start: float, end: float, fraction: float) -> Schedule:
    if not 0.0 < fraction <= 1.0:
        raise UserError(f"a schedule's fraction of the run is in (0, 1]; got {fraction}")
    if kind == "exponential" and min(start, end) <= 0:
        raise UserError(f"an exponential schedule needs positive ends; got {start} and {end}")

    def rate(progress: Float[Array, ""]) -> Float[Array, ""]:
        done = jnp.clip(progress / fraction, 0.0, 1.0)
        if kind == "exponential":
            return start * (end / start) ** done
        if kind == "cosine":
            return end + (start - end) * 0.5 * (1.0 + jnp.cos(jnp.pi * done))
        return start + (end - start) * done

    return rate
