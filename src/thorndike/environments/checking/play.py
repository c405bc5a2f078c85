"""Playing one environment with random actions, with every returned value looked at: what goes wrong is a finding, never a traceback."""

import copy
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, NoReturn, TypeAlias

import gymnasium
import numpy as np

from thorndike.environments.checking.findings import CannotGoOn, Findings
from thorndike.environments.checking.masks import Mask, check_masks, find_masks
from thorndike.environments.checking.observations import Key, Leaf, key_of, read_leaves

Action: TypeAlias = object
"""Whatever the action space samples."""

FIVE = "(observation, reward, terminated, truncated, info)"


class Outcome(NamedTuple):
    """What a reset or a step returned."""

    leaves: list[Leaf]
    key: Key
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False
    mask: Mask | None = None

    @property
    def ended(self) -> bool:
        """Whether the episode is over, for either reason."""
        return self.terminated or self.truncated


class Sampler:
    """Random actions: the same from the same seed, and none that the mask forbids."""

    def __init__(self, space: gymnasium.Space, seed: int) -> None:
        # A copy, so that the environment's own space keeps its random numbers.
        self._space = copy.deepcopy(space)
        self._space.seed(seed)

    def draw(self, mask: Mask | None = None) -> Action:
        """One action."""
        return self._space.sample() if mask is None else self._space.sample(mask=mask)


class Player:
    """One environment; ``reset`` and ``step`` raise CannotGoOn where what came back cannot be used, with the finding added."""

    def __init__(self, environment: gymnasium.Env, findings: Findings) -> None:
        self.environment, self.findings = environment, findings
        self.cost = 0
        """Steps so far, a reset counted as five."""
        self._seed: int | None = None
        self._steps = 0
        self._at_reset = True
        self._masked_by: frozenset[str] | None = None
        self._known_masks: dict[tuple, Mask | None] = {}

    @property
    def place(self) -> str:
        """The last thing done, in words."""
        if not self._at_reset:
            return f"step {self._steps:,} after reset(seed={self._seed})"
        return f"reset() {self._steps:,} steps after reset(seed={self._seed})" if self._steps else f"reset(seed={self._seed})"

    def reset(self, seed: int | None = None) -> Outcome:
        """A new episode: from a seed, or as training goes on after an end, without one."""
        self._at_reset = True
        self.cost += 5
        with self._guarded():
            if seed is None:
                returned = self.environment.reset()
            else:
                self._seed, self._steps = seed, 0
                returned = self.environment.reset(seed=seed)
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], dict)):
            self._refuse(
                "reset_return", f"returned {_described(returned)}, not (observation, info)", "end reset with: return observation, {}"
            )
        return self._outcome(returned[0], returned[1], Outcome([], ()))

    def step(self, action: Action) -> Outcome:
        """One step."""
        self._at_reset = False
        self._steps += 1
        self.cost += 1
        given = copy.copy(action)
        with self._guarded(action):
            returned = self.environment.step(given)
        if isinstance(action, np.ndarray) and not np.array_equal(np.asarray(given), action):
            self.findings.warning(
                "action_changed", f"{self.place}: step wrote to the action it was given", "work on a copy: action = np.array(action)"
            )
        if not isinstance(returned, tuple) or len(returned) != 5:
            self._refuse("step_return", f"returned {_described(returned)}, not {FIVE}", f"end step with: return {FIVE[1:-1]}")
        observation, reward, terminated, truncated, info = returned
        flags = Outcome([], (), self._reward(reward), self._flag("terminated", terminated), self._flag("truncated", truncated))
        if not isinstance(info, dict):
            message = f"{self.place}: info is a {type(info).__name__}, not a dict"
            self.findings.error("info_type", message, "return {} where there is nothing to tell")
            info = {}
        return self._outcome(observation, info, flags)

    def _outcome(self, observation: object, info: dict, flags: Outcome) -> Outcome:
        leaves = read_leaves(self.environment.observation_space, observation, self.place, self.findings)
        return flags._replace(leaves=leaves, key=key_of(leaves), mask=None if flags.ended else self._mask(observation, info))

    def _mask(self, observation: object, info: dict) -> Mask | None:
        with self._guarded():
            found = find_masks(self.environment, observation, info)
        if self._masked_by is None:
            self._masked_by = frozenset(found)
        for source in self._masked_by ^ set(found):
            came = "given, but the first reset gave none" if source in found else "missing, but the first reset gave one"
            self.findings.error("action_mask", f"{self.place}: {source} is {came}", "give it from every reset and every step", source)
        if not found:
            return None
        # The same masks come again and again: what was in order need not be checked again.
        seen = tuple((source, *_content(mask)) for source, mask in found.items())
        if seen in self._known_masks:
            return self._known_masks[seen]
        before = self.findings.total
        mask = check_masks(self.environment.action_space, found, self.place, self.findings)
        if self.findings.total == before:
            self._known_masks[seen] = mask
        return mask

    def _reward(self, value: object) -> float:
        reward = float(value) if isinstance(value, bool | int | float | np.number | np.bool_) else self._array_reward(value)
        if not np.isfinite(reward):
            message = f"{self.place}: the reward is {reward}"
            self.findings.error("reward_not_finite", message, "find the division by zero, logarithm or overflow that makes it")
        return reward

    def _array_reward(self, value: object) -> float:
        """An array of one number is a finding, but can be played on with; anything else cannot."""
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "biuf":
            self._refuse("reward_type", f"the reward is a {type(value).__name__} ({_short(value)}), not a number", "return a number")
        report = self.findings.warning if isinstance(value, np.ndarray) and not array.ndim else self.findings.error
        message = f"{self.place}: the reward is a {type(value).__name__} of shape {array.shape}, not a number"
        report("reward_type", message, "return float(reward)")
        return float(array.item())

    def _flag(self, name: str, value: object) -> bool:
        if isinstance(value, bool | np.bool_):
            return bool(value)
        message, array = f"{name} is a {type(value).__name__} ({_short(value)}), not a bool", np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "biuf":
            self._refuse("end_type", message, f"return bool({name})")
        report = self.findings.warning if isinstance(value, int | np.integer) else self.findings.error
        report("end_type", f"{self.place}: {message}", f"return bool({name})", name)
        return bool(array.item())

    def _refuse(self, kind: str, message: str, fix: str) -> NoReturn:
        self.findings.error(kind, f"{self.place}: {message}", fix)
        raise CannotGoOn

    @contextmanager
    def _guarded(self, action: Action | None = None) -> Iterator[None]:
        """What the environment raises becomes a finding with its line."""
        try:
            yield
        except Exception as error:
            if _unpacked_by_gymnasium(error):
                self._refuse("step_return", f"step did not return {FIVE} ({error})", f"end step with: return {FIVE[1:-1]}")
            where = self.place if action is None else f"{self.place}, action {_short(action)}"
            fix = (
                "make reset work from every state" if action is None else "make step work for every action of action_space, in every state"
            )
            message = f"{where}: {type(error).__name__}: {error} ({_line_of(error, self.environment)})"
            self.findings.error("exception", message, fix)
            raise CannotGoOn from error


def check_signatures(environment: gymnasium.Env, findings: Findings) -> None:
    """``reset(*, seed=None, options=None)`` and ``step(action)``. Raises CannotGoOn if reset takes no seed."""
    own = environment.unwrapped
    taken = _arguments(own.reset)
    missing = [name for name in ("seed", "options") if name not in taken and "**" not in taken]
    if missing:
        findings.error(
            "reset_signature",
            f"{type(own).__name__}.reset does not take {' and '.join(missing)}",
            "def reset(self, *, seed=None, options=None): super().reset(seed=seed); ...",
        )
    required = [name for name, is_required in _arguments(own.step).items() if is_required]
    if len(required) > 1:
        findings.error(
            "step_signature", f"{type(own).__name__}.step needs {len(required)} arguments: {', '.join(required)}", "def step(self, action):"
        )
    if "seed" in missing or len(required) > 1:
        raise CannotGoOn


def _arguments(function: Callable) -> dict[str, bool]:
    """The arguments of a method, and whether each must be given; ``**`` stands for any keyword."""
    found: dict[str, bool] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            found["**"] = False
        elif parameter.kind is not parameter.VAR_POSITIONAL:
            found[name] = parameter.default is parameter.empty
    return found


def _line_of(error: Exception, environment: gymnasium.Env) -> str:
    """Where it was raised: the innermost line of the environment's own file, else the innermost of all."""
    frames = traceback.extract_tb(error.__traceback__)
    kinds = [kind for kind in type(environment.unwrapped).__mro__ if issubclass(kind, gymnasium.Env) and kind is not gymnasium.Env]
    files = {getattr(sys.modules[kind.__module__], "__file__", None) for kind in kinds}
    own = [frame for frame in frames if frame.filename in files]
    frame = (own or list(frames))[-1]
    return f"{frame.filename}, line {frame.lineno}: {frame.line}"


def _unpacked_by_gymnasium(error: Exception) -> bool:
    """Whether one of Gymnasium's wrappers met a step that does not return five values."""
    innermost = traceback.extract_tb(error.__traceback__)[-1]
    return (
        isinstance(error, ValueError) and "to unpack" in str(error) and innermost.filename.startswith(f"{gymnasium.__path__[0]}/wrappers")
    )


def close(environment: gymnasium.Env, findings: Findings) -> None:
    """Close it; what that raises is a finding."""
    try:
        environment.close()
    except Exception as error:
        findings.warning("close", f"close() raised {type(error).__name__}: {error}", "close only what was opened, and only once")


def _content(mask: object) -> tuple[str, ...]:
    """A mask in a form to look up."""
    return (mask.dtype.str, str(mask.shape), mask.tobytes().hex()) if isinstance(mask, np.ndarray) else (repr(mask),)


def _described(returned: object) -> str:
    """What came back, in the fewest words that show the mistake."""
    if isinstance(returned, tuple):
        return f"{len(returned)} values ({', '.join(type(part).__name__ for part in returned)})"
    return f"one value ({type(returned).__name__})"


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 40 else f"{text[:37]}..."
