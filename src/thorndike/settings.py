"""Settings of an algorithm: declared once as the fields of its ``Config``, checked in the same words wherever they come from.

A field is ``gamma: Annotated[float, Between(0, 1)] = 0.99  # discount (gamma)``. ``check`` looks at a finished Config;
``config_fields.py`` reads the same declarations from the source text, so that the command line rejects a bad setting in
milliseconds: nothing here imports JAX, or the algorithm.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Literal, NamedTuple, TypeAlias, Union, get_args, get_origin, get_type_hints

from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean


@dataclass(frozen=True)
class Between:
    """A number from `low` to `high`, both included."""

    low: float
    high: float

    def admits(self, value: object) -> bool:
        """Whether `value` lies inside."""
        return isinstance(value, Real) and self.low <= float(value) <= self.high

    def __str__(self) -> str:
        return f"between {self.low:g} and {self.high:g}"


@dataclass(frozen=True)
class AtLeast:
    """A number not below `low`."""

    low: float

    def admits(self, value: object) -> bool:
        """Whether `value` lies inside."""
        return isinstance(value, Real) and float(value) >= self.low

    def __str__(self) -> str:
        return f"at least {self.low:g}"


@dataclass(frozen=True)
class MoreThan:
    """A number above `low`, which itself is excluded."""

    low: float

    def admits(self, value: object) -> bool:
        """Whether `value` lies inside."""
        return isinstance(value, Real) and float(value) > self.low

    def __str__(self) -> str:
        return f"more than {self.low:g}"


@dataclass(frozen=True, init=False)
class OneOf:
    """One of a few values: ``OneOf("relu", "tanh")``."""

    choices: tuple[str | int | float, ...]

    def __init__(self, *choices: str | int | float) -> None:
        object.__setattr__(self, "choices", choices)

    def admits(self, value: object) -> bool:
        """Whether `value` is one of them."""
        return value in self.choices

    def __str__(self) -> str:
        return "one of " + ", ".join(map(str, self.choices))


Bound: TypeAlias = Between | AtLeast | MoreThan | OneOf
Kind: TypeAlias = object
"""A type as a Config field may name it: int, float, bool, str, None, Literal, tuple, unions of them. Anything else admits everything."""


class FieldFacts(NamedTuple):
    """What is known of one setting."""

    name: str
    kind: Kind
    bounds: tuple[Bound, ...]
    default: str | None
    """The default as it stands in the source, None where the setting has none."""
    comment: str
    """The field's one-line comment: what it is, and the paper's symbol."""


# How other libraries call what is meant here by Stable-Baselines3's names.
_FOREIGN_NAMES = {
    "lr": "learning_rate",
    "alpha": "learning_rate",
    "step_size": "learning_rate",
    "discount": "gamma",
    "discount_factor": "gamma",
    "lambda": "gae_lambda",
    "clip_coef": "clip_range",
    "clip_eps": "clip_range",
    "num_steps": "n_steps",
    "rollout_length": "n_steps",
    "update_epochs": "n_epochs",
    "num_epochs": "n_epochs",
    "minibatch_size": "batch_size",
    "entropy_coef": "ent_coef",
    "value_coef": "vf_coef",
    "target_network_frequency": "target_update_interval",
    "replay_size": "buffer_size",
    "start_e": "exploration_initial_eps",
    "end_e": "exploration_final_eps",
}


def check(config: object) -> None:
    """Check every field of a Config dataclass against its declared type and bounds; for its ``__post_init__``.

    Raises UserError naming the algorithm, the field, the value and what was expected.
    """
    where = type(config).__module__.rpartition(".")[2]
    config_class: type = type(config)
    for facts in _declared(config_class):
        check_value(getattr(config, facts.name), facts, where)


def settings_of(config: object) -> dict[str, object]:
    """The fields of a Config dataclass by name, as a run records them."""
    kind: type = type(config)
    return {field.name: getattr(config, field.name) for field in fields(kind)}


def parse_settings(texts: Iterable[str], known: Mapping[str, FieldFacts], algorithm: str) -> dict[str, object]:
    """``["gamma=0.9", ...]`` as values of the declared types; of a name given twice the last counts.

    Raises UserError for a text without ``=``, a name that is not known, a value of another type or out of bounds.
    """
    values: dict[str, object] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        name = name.replace("-", "_")
        if not equals or not name:
            raise UserError(f"--set {text}: expected NAME=VALUE, for example --set gamma=0.99")
        values[name] = parse_value(value, find_setting(name, known, algorithm), algorithm)
    return values


def find_setting(name: str, known: Mapping[str, FieldFacts], algorithm: str) -> FieldFacts:
    """The facts of a setting. Raises UserError, with a suggestion, if there is none of that name."""
    if name not in known:
        raise UserError(f"{algorithm} has no setting '{name}'{_suggest_setting(name, known)}")
    return known[name]


def parse_value(text: str, facts: FieldFacts, algorithm: str) -> object:
    """A text as a value of the declared type. Raises UserError for one of another type or out of bounds."""
    value = _parse(text, facts.kind)
    check_value(value, facts, algorithm)
    return value


def describe_kind(kind: Kind) -> str:
    """A type in a newcomer's words: "a whole number", "true or false"."""
    if kind in _WORDS:
        return _WORDS[kind]
    if is_rate(kind):
        return "a number or a schedule such as linear(1e-3, 0)"
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if origin in (Union, UnionType):
        return " or ".join(describe_kind(argument) for argument in arguments)
    if origin is tuple:
        return f"a list such as {_EXAMPLES.get(arguments[0], 'a,b')}"
    return "a value that only Python code can give"


_WORDS: dict[Kind, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a word", NoneType: "none"}
_EXAMPLES: dict[Kind, str] = {int: "64,64", float: "0.1,0.2", str: "a,b"}


def check_value(value: object, facts: FieldFacts, where: str) -> None:
    """Raises UserError for a value that is not of the declared type, or out of bounds."""
    default = "" if facts.default is None else f" (default {facts.default})"
    expected = describe_kind(facts.kind)
    if not _matches(value, facts.kind):
        raise UserError(f"{where}: {facts.name} = {value!r}, but it must be {expected}{default}")
    for bound in facts.bounds:
        if not all(bound.admits(part) for part in _parts(value)):
            raise UserError(f"{where}: {facts.name} = {value}, but it must be {bound}{default}")
    if not all(_is_usable(part) for part in _parts(value)):
        raise UserError(f"{where}: {facts.name} = {value}, but it must be finite, and a whole number below 2^53{default}")


def _matches(value: object, kind: Kind) -> bool:
    origin, arguments = get_origin(kind), get_args(kind)
    if is_rate(kind) and isinstance(value, str):
        return _rates_of(value) is not None
    if origin in (Union, UnionType):
        return any(_matches(value, argument) for argument in arguments)
    if origin is Literal:
        return value in arguments
    if origin is tuple:
        elements = arguments[:1] if arguments[-1] is Ellipsis else arguments
        return isinstance(value, tuple) and all(any(_matches(part, element) for element in elements) for part in value)
    if kind is float or kind is int:
        return isinstance(value, Real if kind is float else Integral) and not isinstance(value, bool)
    return not isinstance(kind, type) or kind is object or isinstance(value, kind)


def _is_usable(value: object) -> bool:
    """Whether a number is finite, and if it is whole no larger than what a float can tell from the next."""
    return not isinstance(value, Real) or (abs(int(value)) < _MOST if isinstance(value, Integral) else math.isfinite(value))


_MOST = 2**53


def _parts(value: object) -> tuple[object, ...]:
    """What the bounds of a field speak about: the value, the elements of a tuple, the ends of a schedule; nothing for None."""
    if value is None:
        return ()
    if isinstance(value, tuple):
        return value
    schedule = _rates_of(value) if isinstance(value, str) else None
    return (value,) if schedule is None else schedule


# The grammar of functional/schedules.py, which needs JAX; a test holds the two together.
_SCHEDULE = re.compile(r"(?P<name>linear|cosine|exponential)\((?P<numbers>[^()]*)\)")


def _rates_of(text: str) -> tuple[float, ...] | None:
    """The rates a schedule starts and ends with, or the one of a plain number; None for text that is no schedule."""
    match = _SCHEDULE.fullmatch(text.strip())
    numbers = [_number(part, whole=False) for part in (match["numbers"].split(",") if match else [text.removeprefix("lin_")])]
    if not all(isinstance(number, float) and math.isfinite(number) for number in numbers):
        return None
    rates = tuple(float(str(number)) for number in numbers)
    if match is None:
        return rates
    positive = match["name"] != "exponential" or min(rates[:2]) > 0
    sound = len(rates) in (2, 3) and positive and all(0 < fraction <= 1 for fraction in rates[2:])
    return rates[:2] if sound else None


def is_rate(kind: Kind) -> bool:
    """Whether a setting takes a number or a schedule."""
    return get_origin(kind) in (Union, UnionType) and {float, str} <= set(get_args(kind))


def _parse(text: str, kind: Kind) -> object:
    """The text as `kind`, or as it is where it fits none: `check_value` then says what was expected."""
    for candidate in get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,):
        value = _parse_one(text, candidate)
        if _matches(value, candidate):
            return value
    return text


def _parse_one(text: str, kind: Kind) -> object:
    if kind is bool:
        return _TRUTH.get(text.lower(), text)
    if kind is NoneType:
        return None if text.lower() in ("none", "null") else text
    if kind is int or kind is float:
        return _number(text, whole=kind is int)
    if get_origin(kind) is Literal:
        return next((choice for choice in get_args(kind) if str(choice) == text), text)
    if get_origin(kind) is tuple:
        parts = [part.strip() for part in text.strip("()[] ").split(",")]
        return tuple(_parse_one(part, get_args(kind)[0]) for part in parts if part)
    return text


_TRUTH = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def _number(text: str, whole: bool) -> object:
    try:
        value = float(text)
    except ValueError:
        return text
    if not whole:
        return value
    return int(value) if math.isfinite(value) and value == int(value) else text


def _suggest_setting(name: str, known: Mapping[str, FieldFacts]) -> str:
    meant = _FOREIGN_NAMES.get(name.lower())
    return f"; did you mean '{meant}'?" if meant in known else did_you_mean(name, known)


@lru_cache(maxsize=64)
def _declared(config_class: type) -> tuple[FieldFacts, ...]:
    hints = get_type_hints(config_class, include_extras=True)
    return tuple(facts_of(field.name, hints[field.name]) for field in fields(config_class))


def facts_of(name: str, annotation: object, default: str | None = None, comment: str = "") -> FieldFacts:
    """The facts of a setting of that annotation, default and comment."""
    bounds: tuple[Bound, ...] = ()
    if get_origin(annotation) is Annotated:
        annotation, *extras = get_args(annotation)
        bounds = tuple(extra for extra in extras if isinstance(extra, Bound))
    return FieldFacts(name, annotation, bounds, default, comment)
