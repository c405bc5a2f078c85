"""What a sweep tries: lists and ranges of settings, as they are written, checked, and drawn from. Nothing here imports JAX."""

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, get_args, get_origin

from thorndike.errors import UserError
from thorndike.settings import FieldFacts, check_value, describe_kind, find_setting, is_rate, parse_value

if TYPE_CHECKING:
    import numpy as np

Settings: TypeAlias = dict[str, object]
Over: TypeAlias = Mapping[str, str | Sequence[object]]
"""Setting -> values to try, or a text as the command line takes it: ``"1e-4,3e-4"``, ``"log(1e-5,1e-2)"``."""

SEARCHES = ("auto", "grid", "random", "optuna")
DEFAULT_TRIALS = 20
MOST_TRIALS = 10_000
_RANGE = re.compile(r"(?P<scale>[a-z_]+)\((?P<ends>[^()]*)\)")
_SCALES = ("uniform", "log")
_NOT_SETTINGS = {"seeds": "--seeds", "seed": "--seed", "steps": "--steps", "total_steps": "--steps", "num_envs": "--num-envs"}
_DRAWING = 0x44524157
"""Separates the drawing of trials from all that follows from the same seed."""


class Swept(NamedTuple):
    """One setting and what is tried of it: some values, or a range."""

    name: str
    values: tuple[object, ...] = ()
    low: float = 0.0
    high: float = 0.0
    scale: str = "list"
    """``list``, ``uniform`` or ``log``."""
    whole: bool = False
    """Whether a number drawn from the range is whole."""

    @property
    def is_range(self) -> bool:
        """Whether numbers are drawn, not listed."""
        return self.scale != "list"

    def written(self) -> str | list[object]:
        """What ``sweep.json`` keeps; ``swept_settings`` reads it."""
        if self.is_range:
            return f"{self.scale}({self.low!r},{self.high!r})"
        return [list(value) if isinstance(value, tuple) else value for value in self.values]


class Search(NamedTuple):
    """How trials are chosen."""

    kind: str
    """``grid``, ``random`` or ``optuna``."""
    trials: int


def over_texts(texts: Iterable[str]) -> dict[str, str]:
    """``["gamma=0.9,0.99", ...]`` as setting -> text. Raises UserError for a text without ``=``, or a name given twice."""
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        name = name.replace("-", "_")
        if not equals or not name:
            raise UserError(f"--over {text}: expected NAME=VALUES, for example --over gamma=0.98,0.99")
        if name in found:
            raise UserError(f"--over {name} is given twice: put all its values into one --over")
        found[name] = value
    return found


def swept_settings(over: Over, known: Mapping[str, FieldFacts], algorithm: str, fixed: Mapping[str, object]) -> tuple[Swept, ...]:
    """What is swept, checked. Raises UserError for what is no setting, a value that it cannot have, or a setting that is fixed too."""
    if not over:
        raise UserError("a sweep needs a setting to vary, as in --over learning_rate=1e-4,3e-4 or --over 'learning_rate=log(1e-5,1e-2)'")
    found = []
    for name, given in over.items():
        if name in _NOT_SETTINGS:
            raise UserError(f"{name} cannot be swept: it is given once, by {_NOT_SETTINGS[name]}")
        facts = find_setting(name, known, algorithm)
        if name in fixed:
            raise UserError(f"{name} is both fixed (--set) and swept (--over): leave one of them out")
        found.append(_from_text(given.strip(), facts, algorithm) if isinstance(given, str) else _from_values(given, facts, algorithm))
    return tuple(found)


def chosen_search(swept: Sequence[Swept], search: str, trials: int | None) -> Search:
    """How trials are chosen, and how many. Raises UserError for a number that has no use, or a grid of ranges."""
    ranges = [each.name for each in swept if each.is_range]
    combinations = math.prod(len(each.values) for each in swept if not each.is_range)
    kind = search if search != "auto" else "random" if ranges or trials is not None else "grid"
    if kind == "grid":
        if ranges:
            raise UserError(f"a grid needs lists, but {', '.join(ranges)} is a range: use --search random, or list values")
        if trials is not None:
            raise UserError(f"a grid tries all its {combinations} combinations: leave --trials out")
        trials = combinations
    elif not ranges and trials is not None and trials >= combinations:
        raise UserError(f"there are only {combinations} combinations, so --trials {trials} has no use: leave it out to try them all")
    elif trials is None:
        trials = DEFAULT_TRIALS if ranges else min(DEFAULT_TRIALS, combinations)
    if trials > MOST_TRIALS:
        raise UserError(f"{trials:,} trials are more than a sweep takes ({MOST_TRIALS:,}): list fewer values, or use --trials")
    return Search(kind, trials)


def listed_trials(swept: Sequence[Swept], search: Search, seed: int) -> list[Settings]:
    """The settings of every trial of a grid (the last setting varies fastest) or a random search (which follows from ``seed``)."""
    if search.kind == "grid":
        return _combinations(swept)
    import numpy as np

    generator = np.random.default_rng([seed, _DRAWING])
    if not any(each.is_range for each in swept):
        grid = _combinations(swept)
        return [grid[i] for i in generator.choice(len(grid), search.trials, replace=False)]
    return [{each.name: _drawn(each, generator) for each in swept} for _ in range(search.trials)]


def _combinations(swept: Sequence[Swept]) -> list[Settings]:
    names = [each.name for each in swept]
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*(each.values for each in swept))]


def _drawn(swept: Swept, generator: "np.random.Generator") -> object:
    if not swept.is_range:
        return swept.values[generator.integers(len(swept.values))]
    if swept.scale == "uniform":
        return (
            int(generator.integers(int(swept.low), int(swept.high) + 1)) if swept.whole else float(generator.uniform(swept.low, swept.high))
        )
    # Every whole number n has the share of [n, n + 1) on the logarithmic scale.
    low, high = math.log(swept.low), math.log(swept.high + 1 if swept.whole else swept.high)
    number = math.exp(generator.uniform(low, high))
    return int(min(max(math.floor(number), swept.low), swept.high)) if swept.whole else min(max(number, swept.low), swept.high)


def _from_text(text: str, facts: FieldFacts, algorithm: str) -> Swept:
    match = _RANGE.fullmatch(text)
    if match is not None and not (is_rate(facts.kind) and match["scale"] in ("linear", "cosine", "exponential")):
        return _range(match["scale"], match["ends"], facts, algorithm)
    parts = [part.strip() for part in _split(text, facts)]
    return _list([parse_value(part, facts, algorithm) for part in parts if part], facts)


def _from_values(values: Sequence[object], facts: FieldFacts, algorithm: str) -> Swept:
    plain = [tuple(value) if isinstance(value, list) else value for value in values]
    kinds = _kinds(facts)
    if float in kinds and int not in kinds:
        plain = [float(value) if type(value) is int else value for value in plain]
    for value in plain:
        check_value(value, facts, algorithm)
    return _list(plain, facts)


def _list(values: Sequence[object], facts: FieldFacts) -> Swept:
    if len(values) < 2:
        between = ";" if _takes_lists(facts) else ","
        what = "has no value" if not values else f"has the one value {values[0]}"
        raise UserError(f"--over {facts.name} {what}: a sweep compares two or more, with '{between}' between; --set fixes one")
    twice = [value for i, value in enumerate(values) if value in values[:i]]
    if twice:
        raise UserError(f"--over {facts.name} has {twice[0]} twice")
    return Swept(facts.name, tuple(values))


def _range(scale: str, ends: str, facts: FieldFacts, algorithm: str) -> Swept:
    where = f"--over {facts.name}={scale}({ends})"
    if scale not in _SCALES:
        raise UserError(f"{where}: a range is uniform(LOW,HIGH) or log(LOW,HIGH)")
    kinds = _kinds(facts)
    if not {int, float} & set(kinds):
        raise UserError(f"{where}: {facts.name} is {describe_kind(facts.kind)}, which has no range: list its values")
    whole = float not in kinds
    numbers = [parse_value(part.strip(), facts, algorithm) for part in ends.split(",")]
    if len(numbers) != 2 or not all(isinstance(number, int | float) for number in numbers):
        raise UserError(f"{where}: expected two numbers, as in {scale}(1e-5,1e-2)")
    low, high = (float(str(number)) for number in numbers)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UserError(f"{where}: the first number must be below the second, and both finite")
    if scale == "log" and low <= 0:
        raise UserError(f"{where}: a logarithmic range begins above 0")
    return Swept(facts.name, (), low, high, scale, whole)


def _split(text: str, facts: FieldFacts) -> list[str]:
    """The values of a list: at each ``;``, or else at the commas outside parentheses; a list of lists only at ``;``."""
    if ";" in text or _takes_lists(facts):
        return text.split(";")
    return re.split(r",(?![^()]*\))", text)


def _kinds(facts: FieldFacts) -> tuple[object, ...]:
    """The types a setting may have."""
    return get_args(facts.kind) if get_origin(facts.kind) is not tuple and get_args(facts.kind) else (facts.kind,)


def _takes_lists(facts: FieldFacts) -> bool:
    return any(get_origin(kind) is tuple for kind in _kinds(facts))
