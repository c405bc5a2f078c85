"""Whether what an environment gave is what its spaces say.

Always: keys, shape and dtype of every observation, values of a Discrete one, and that observations and rewards are finite. Every value
against the bounds of its space, and the types of rewards and flags: in the first 1,000 steps and every 100th after, for that costs more. A
dtype is right if it can become the dtype a learner sees (float32, int32, uint8) without a change of kind: float64 for float32 is, a
float or a wider integer for uint8 is not. What the checks cost is in docs/faults.md.

Kept free of JAX, so that worker processes start fast.
"""

from collections.abc import Callable, Mapping
from math import isfinite
from numbers import Real
from typing import TYPE_CHECKING, TypeAlias

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.host.arrays import array_dtype
from thorndike.environments.host.faults import Fault

if TYPE_CHECKING:
    # An array, or a dict or tuple of them; jaxtyping would bring JAX.
    from jaxtyping import PyTree

    Store: TypeAlias = Callable[[PyTree, int, PyTree], None]

STEP_GIVES = "(observation, reward, terminated, truncated, info)"
RESET_GIVES = "(observation, info)"
_FIRST, _EVERY = 1000, 100
_FEW = 64
_PLAIN_NUMBERS = (float, int, np.float32, Real)
_LOOSE_BOUNDS = frozenset(["LunarLander", "LunarLanderContinuous", "BipedalWalker", "BipedalWalkerHardcore"])
"""Gymnasium's tasks whose observations leave their own Box: with random actions in up to 5 % of LunarLander's steps."""


def due(step: int) -> bool:
    """Whether the costly checks are made in this step."""
    return step <= _FIRST or step % _EVERY == 0


def bounds_hold(environment: gymnasium.Env | gymnasium.vector.VectorEnv) -> bool:
    """Whether the float bounds of this environment's observation space can be believed."""
    spec = environment.spec
    return spec is None or spec.id.partition("-v")[0] not in _LOOSE_BOUNDS


def storer(space: gymnasium.Space, path: str = "") -> "Store":
    """A function that writes one observation into a row of batched arrays, or raises Fault: keys, shape, dtype, and Discrete values."""
    match space:
        case spaces.Dict():
            return _dict_storer(space, path)
        case spaces.Tuple():
            return _tuple_storer(space, path)
        case spaces.Discrete():
            return _discrete_storer(space, path)
    shape, accepted = space.shape, _accepted(space)

    def store(arrays: np.ndarray, row: int, observation: np.ndarray) -> None:
        observation = _as_array(observation, path)
        if observation.shape != shape or observation.dtype.char not in accepted:
            raise _form_fault(space, observation, path)
        arrays[row] = observation

    return store


def finite_test(space: gymnasium.Space) -> "Callable[[PyTree], bool]":
    """A function that tells whether all floats of batched arrays of this space are finite."""
    match space:
        case spaces.Dict():
            parts = {key: finite_test(part) for key, part in space.items() if _has_floats(part)}
            return lambda arrays: all(test(arrays[key]) for key, test in parts.items())
        case spaces.Tuple():
            members = [(place, finite_test(part)) for place, part in enumerate(space) if _has_floats(part)]
            return lambda arrays: all(test(arrays[place]) for place, test in members)
    return all_finite if _has_floats(space) else lambda arrays: True


def all_finite(array: np.ndarray) -> bool:
    """Whether no number of a float32 array is NaN or infinite."""
    if array.size <= _FEW:
        # In Python's 64 bits no sum of these overflows, and no vector unit has to wake up for it.
        return isfinite(sum(array.ravel().tolist()))
    flat = array.ravel()
    # The sum of squares is finite only if all of them are, and one product of BLAS takes a third of the time of isfinite().all().
    return isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())


def not_finite(space: gymnasium.Space, arrays: "PyTree") -> Fault:
    """The first row of batched arrays that is not finite, and what is there. Call it when ``finite_test`` says so."""
    found = [
        (int(position[0]), f"returned {_value(leaf, position)} in observation{path}{_at(position[1:])}")
        for path, leaf in _float_leaves(space, arrays, "")
        for position in np.argwhere(~np.isfinite(leaf))[:1]
    ]
    row, what = min(found)
    return Fault(what, "return finite numbers", row)


def reward_not_finite(rewards: np.ndarray) -> Fault:
    """The first row whose reward is not finite."""
    row = int(np.flatnonzero(~np.isfinite(rewards))[0])
    return Fault(f"returned a reward that is {rewards[row]} in float32", "return a finite number", row)


def check_values(space: gymnasium.Space, arrays: "PyTree", bounds: bool, path: str = "") -> None:
    """Raises Fault if a row of batched arrays is not within its space; floats are compared with their bounds only if `bounds`."""
    match space:
        case spaces.Dict():
            for key, part in space.items():
                check_values(part, arrays[key], bounds, f"{path}[{key!r}]")
        case spaces.Tuple():
            for place, part in enumerate(space):
                check_values(part, arrays[place], bounds, f"{path}[{place}]")
        case _ if bounds or not _has_floats(space):
            low, high = _bounds(space)
            outside = np.argwhere((arrays < low) | (arrays > high))
            if outside.size:
                raise _outside(space, arrays[outside[0, 0]], outside[0, 1:], path, int(outside[0, 0]))


def check_flags(terminated: object, truncated: object) -> None:
    """Raises Fault unless both are true or false; 0 and 1 will do."""
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, bool | np.bool_ | int | np.integer) or flag not in (0, 1):
            raise Fault(f"returned {flag!r:.60} for {name}", "return True or False")


def number(reward: object) -> float:
    """A reward as a float. Raises Fault for anything but one real number."""
    if isinstance(reward, _PLAIN_NUMBERS) or (isinstance(reward, np.ndarray) and reward.ndim == 0):
        return float(reward)
    shape = np.shape(reward) if isinstance(reward, np.ndarray | list | tuple) else ()
    came = f"of shape {shape}" if shape else f"{reward!r:.60}"
    raise Fault(f"returned a reward {came}, where one number is expected", "return a float")


def checked_rows(values: "PyTree", count: int, name: str, kinds: str) -> np.ndarray:
    """A vector's rewards or flags ``[B]``. Raises Fault for another shape, or a dtype that is none of these kinds."""
    rows = np.asarray(values)
    if rows.shape != (count,) or rows.dtype.kind not in kinds:
        raise Fault(f"returned {name} of shape {rows.shape} and dtype {rows.dtype}, where one an environment is expected", "make them so")
    return rows


def checked_batch(space: gymnasium.Space, batch: "PyTree", count: int, path: str = "") -> "PyTree":
    """A vector's batched observation as new arrays of the dtypes a learner sees. Raises Fault for other keys, shapes or dtypes."""
    match space:
        case spaces.Dict():
            _check_keys(space, batch, path)
            return {key: checked_batch(part, batch[key], count, f"{path}[{key!r}]") for key, part in space.items()}
        case spaces.Tuple():
            _check_length(space, batch, path)
            return tuple(
                checked_batch(part, value, count, f"{path}[{place}]") for place, (part, value) in enumerate(zip(space, batch, strict=True))
            )
    value = _as_array(batch, path)
    if value.shape != (count, *(space.shape or ())) or value.dtype.char not in _accepted(space):
        raise _form_fault(space, value, path, (count,))
    return np.array(value, array_dtype(space.dtype))


def _dict_storer(space: spaces.Dict, path: str) -> "Store":
    parts = [(key, storer(part, f"{path}[{key!r}]")) for key, part in space.items()]
    keys = dict(parts).keys()

    def store(arrays: "PyTree", row: int, observation: "PyTree") -> None:
        if not isinstance(observation, Mapping) or observation.keys() != keys:
            _check_keys(space, observation, path)
        for key, part in parts:
            part(arrays[key], row, observation[key])

    return store


def _tuple_storer(space: spaces.Tuple, path: str) -> "Store":
    parts = [storer(part, f"{path}[{place}]") for place, part in enumerate(space)]

    def store(arrays: "PyTree", row: int, observation: "PyTree") -> None:
        _check_length(space, observation, path)
        for part, array, value in zip(parts, arrays, observation, strict=True):
            part(array, row, value)

    return store


def _discrete_storer(space: spaces.Discrete, path: str) -> "Store":
    first, end, accepted = int(space.start), int(space.start + space.n), _accepted(space)

    def store(arrays: np.ndarray, row: int, observation: "int | np.integer | np.ndarray") -> None:
        if type(observation) is not int:
            value = _as_array(observation, path)
            if value.shape != () or value.dtype.char not in accepted:
                raise _form_fault(space, value, path)
        if not first <= observation < end:
            raise _outside(space, np.asarray(observation), np.array([], np.intp), path)
        arrays[row] = observation

    return store


def _check_keys(space: spaces.Dict, observation: "PyTree", path: str) -> None:
    if isinstance(observation, Mapping) and set(observation) == set(space.keys()):
        return
    keys = sorted(space.keys())
    if isinstance(observation, Mapping):
        came = f"an observation{path} of the keys {sorted(map(str, observation))}"
    else:
        came = f"a {type(observation).__name__} for observation{path}"
    raise Fault(f"returned {came}, but its space has the keys {keys}", "make them agree")


def _check_length(space: spaces.Tuple, observation: "PyTree", path: str) -> None:
    if not isinstance(observation, tuple | list):
        raise Fault(f"returned a {type(observation).__name__} for observation{path}, but its space is a Tuple", "make them agree")
    if len(observation) != len(space):
        raise Fault(f"returned {len(observation)} parts in observation{path}, but its space has {len(space)}", "make them agree")


def _form_fault(space: gymnasium.Space, value: np.ndarray, path: str, lead: tuple[int, ...] = ()) -> Fault:
    expected = (*lead, *(space.shape or ()))
    if value.shape != expected:
        return Fault(f"returned an observation{path} of shape {value.shape}, but its space says {expected}", "make them agree")
    return Fault(f"returned an observation{path} of dtype {value.dtype}, but its space says {space.dtype}", "make them agree")


def _outside(space: gymnasium.Space, value: np.ndarray, position: np.ndarray, path: str, row: int | None = None) -> Fault:
    low, high = (_value(np.broadcast_to(bound, value.shape), position) for bound in _bounds(space))
    return Fault(
        f"returned {_value(value, position)} in observation{path}{_at(position)}, but its space goes from {low} to {high}",
        "keep to the space, or widen it (gymnasium.wrappers.TransformObservation)",
        row,
    )


def _bounds(space: gymnasium.Space) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest value, in the dtype a learner sees: rounded as observations are, so that a bound is within its space."""
    dtype = array_dtype(space.dtype)
    match space:
        case spaces.Box():
            low, high = space.low, space.high
        case spaces.Discrete() | spaces.MultiDiscrete():
            count = space.n if isinstance(space, spaces.Discrete) else space.nvec
            low, high = np.asarray(space.start), np.asarray(space.start + count - 1)
        case _:
            low, high = np.zeros(space.shape or (), dtype), np.ones(space.shape or (), dtype)
    if dtype == np.int32:
        low, high = (np.clip(bound, np.iinfo(dtype).min, np.iinfo(dtype).max) for bound in (low, high))
    return low.astype(dtype), high.astype(dtype)


def _accepted(space: gymnasium.Space) -> frozenset[str]:
    """The type characters of the dtypes an observation may have."""
    kinds = "?" + np.typecodes["AllInteger"] + np.typecodes["Float"]
    return frozenset(kind for kind in kinds if np.can_cast(kind, array_dtype(space.dtype), "same_kind"))


def _as_array(value: "PyTree", path: str) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError:
        raise Fault(f"returned a {type(value).__name__} for observation{path} that is no array", "return a NumPy array") from None


def _has_floats(space: gymnasium.Space) -> bool:
    match space:
        case spaces.Dict():
            return any(_has_floats(part) for part in space.values())
        case spaces.Tuple():
            return any(_has_floats(part) for part in space)
    return array_dtype(space.dtype) == np.float32


def _float_leaves(space: gymnasium.Space, arrays: "PyTree", path: str) -> list[tuple[str, np.ndarray]]:
    match space:
        case spaces.Dict():
            return [leaf for key, part in space.items() for leaf in _float_leaves(part, arrays[key], f"{path}[{key!r}]")]
        case spaces.Tuple():
            return [leaf for place, part in enumerate(space) for leaf in _float_leaves(part, arrays[place], f"{path}[{place}]")]
    return [(path, arrays)] if _has_floats(space) else []


def _value(array: np.ndarray, position: np.ndarray) -> str:
    return str(array[tuple(position)])


def _at(position: np.ndarray) -> str:
    return f" at {position.tolist()}" if position.size else ""
