"""Agents of one compiled program that differ in their settings: the settings become part of the learner's state.

Which settings can differ there is found out by tracing, not listed: a setting that changes a shape or the program's course cannot.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax.extend.core import Var
from jaxtyping import Array, Key, PyTree

from thorndike.functional.schedules import Rate, parse_rate
from thorndike.networks.torso import example_observation
from thorndike.training.segment import over_seeds
from thorndike.types import Algorithm, EnvSpec, Metrics, Observation, Rollout, Step

Numbers: TypeAlias = tuple[Array, ...]
"""A setting as numbers: itself, or a schedule's start, end and fraction."""
LaneSettings: TypeAlias = dict[str, Numbers]
"""Setting -> numbers; as arrays ``[S]`` of all agents of a program."""
Build: TypeAlias = Callable[[Mapping[str, object]], Algorithm]
"""Some settings (numbers or ``Rate``, concrete or traced) in place of those that the algorithm has otherwise -> the algorithm."""

_FORM_OF_NUMBERS = ("whole", "number")


class Varied(NamedTuple):
    """A learner's state, or its actor, beside the settings that are its own."""

    settings: LaneSettings
    inner: PyTree


class Found(NamedTuple):
    """Which settings can differ within a program."""

    traced: tuple[str, ...]
    structural: dict[str, str]
    """Those that cannot, and why."""


class NotTraceable(Exception):
    """A setting reaches what is fixed before a program runs."""


def form_of(value: object) -> str | None:
    """What kind of number a setting's value is (``whole``, ``number``, ``linear``, ...), None if it is none: a word, a list, a flag."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return "whole" if isinstance(value, int) else "number"
    rate = _rate_in(value)
    return None if rate is None else rate.kind if isinstance(rate, Rate) else "number"


def numbers_of(value: object) -> Numbers:
    """A value that has a form, as numbers."""
    rate = _rate_in(value) if isinstance(value, str) else value
    if isinstance(rate, Rate):
        return tuple(jnp.asarray(number, jnp.float32) for number in rate[1:])
    return (jnp.asarray(rate, jnp.int32 if isinstance(rate, int) else jnp.float32),)


def setting_of(numbers: Numbers, form: str) -> object:
    """What an algorithm's ``Config`` holds in place of the value, its numbers traced."""
    return numbers[0] if form in _FORM_OF_NUMBERS else Rate(form, *numbers)


def varied(build: Build, forms: Mapping[str, str], kept: Algorithm, first: LaneSettings) -> Algorithm:
    """``kept``, whose agents have settings of their own in their state; ``forms`` says which and of what form.

    Every function builds the algorithm again, while it is traced, with the settings of the agent at hand. ``init`` gives all agents
    ``first``; ``settle`` gives them their own.
    """

    def of(each: Varied) -> Algorithm:
        return build(settings_in(each.settings, forms))

    def update(state: Varied, rollout: Rollout, key: Key[Array, ""]) -> tuple[Varied, Metrics]:
        inner, metrics = of(state).update(state.inner, rollout, key)
        return state._replace(inner=inner), metrics

    def observe(state: Varied, rollout: Rollout, key: Key[Array, ""]) -> tuple[Varied, Metrics]:
        inner, metrics = of(state).observe(state.inner, rollout, key)
        return state._replace(inner=inner), metrics

    return kept._replace(
        init=lambda key: Varied(jax.tree.map(jnp.asarray, first), kept.init(key)),
        actor=lambda state: state._replace(inner=of(state).actor(state.inner)),
        act=lambda actor, memory, obs, noise: of(actor).act(actor.inner, memory, obs, noise),
        greedy=lambda actor, memory, obs, noise: of(actor).greedy(actor.inner, memory, obs, noise),
        value=lambda actor, obs: of(actor).value(actor.inner, obs),
        update=update,
        observe=observe,
        # Lanes have no log to keep it in.
        dynamics=None,
    )


def settle(build: Build, forms: Mapping[str, str], settings: LaneSettings, keys: Key[Array, " S"]) -> Varied:
    """The first state ``[S, ...]`` of agents with settings ``[S]`` of their own, from the keys that their learners begin with."""
    return Varied(settings, jax.vmap(lambda own, key: build(settings_in(own, forms)).init(key))(settings, keys))


def settings_in(numbers: LaneSettings, forms: Mapping[str, str]) -> dict[str, object]:
    """The settings of one agent, as ``build`` takes them."""
    return {name: setting_of(own, forms[name]) for name, own in numbers.items()}


def find_traced(build: Build, values: Mapping[str, object], spec: EnvSpec) -> Found:
    """Which of these settings (name -> one value that has a form) can differ within a program; ``spec`` is as the learner sees it.

    What the algorithm raises with its own settings is the user's mistake and passes through. What it raises only where a setting is
    traced makes that setting structural, as does a change of any shape, of ``needs``, or of what has no settings: ``draw``, ``memory``.
    """
    expected = outcome_shapes(build, {}, spec)
    names = tuple(values)
    together = _why_not(build, values, names, spec, expected)
    if together is None:
        return Found(names, {})
    reasons = {name: _why_not(build, values, (name,), spec, expected) for name in names}
    traced = tuple(name for name, reason in reasons.items() if reason is None)
    structural = {name: reason for name, reason in reasons.items() if reason is not None}
    if traced and (together if not structural else _why_not(build, values, traced, spec, expected)) is not None:
        raise NotTraceable(f"{', '.join(traced)} can be traced one by one, but not together")
    return Found(traced, structural)


def outcome_shapes(build: Build, values: Mapping[str, object], spec: EnvSpec) -> PyTree:
    """The shapes of all that an algorithm gives in one iteration, the settings ``values`` being traced."""
    forms = {name: str(form_of(value)) for name, value in values.items()}
    numbers = {name: tuple(jnp.stack([n, n]) for n in numbers_of(value)) for name, value in values.items()}
    plain = build({})

    def one(numbers: LaneSettings, key: Key[Array, ""]) -> PyTree:
        algorithm = build(settings_in(numbers, forms))
        if any(isinstance(need, jax.core.Tracer) for need in algorithm.needs) or algorithm.needs != plain.needs:
            raise NotTraceable("it changes what the learner asks of its source")
        return _outcome(algorithm._replace(draw=plain.draw, memory=plain.memory), spec, key)

    keys = jax.random.split(jax.random.key(0), 2)
    return jax.eval_shape(lambda numbers, keys: over_seeds(one)(numbers, keys), numbers, keys)


_SAYS_STRUCTURAL = (TypeError, ValueError, IndexError, NotImplementedError, AssertionError, NotTraceable)
"""What JAX, NumPy and Python raise where a number must be known and is traced, and learners where its text or size is looked at.

AssertionError: JAX's, where a rule for ``vmap`` of one's own (a table's, on an accelerator) closes over the number.
"""


def _why_not(build: Build, values: Mapping[str, object], names: Sequence[str], spec: EnvSpec, expected: PyTree) -> str | None:
    """Why these settings cannot be traced together; None if they can."""
    tried = {name: values[name] for name in names}
    try:
        found = outcome_shapes(build, tried, spec)
        _refuse_hidden_use(build, tried)
    # With concrete settings the same code has just run: what fails now, fails because they are traced.
    except _SAYS_STRUCTURAL as error:
        return f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}"
    return None if _same(found, expected) else "it changes a shape or a type"


def _refuse_hidden_use(build: Build, values: Mapping[str, object]) -> None:
    """Raises ``NotTraceable`` if ``draw`` or ``memory``, which see no state, use the settings."""
    forms = {name: str(form_of(value)) for name, value in values.items()}

    def unseen(numbers: LaneSettings) -> PyTree:
        algorithm = build(settings_in(numbers, forms))
        return algorithm.draw(jax.random.key(0), 1), algorithm.memory(1)

    program = jax.make_jaxpr(unseen)({name: numbers_of(value) for name, value in values.items()}).jaxpr
    used = {variable for variable in program.outvars if isinstance(variable, Var)}
    for equation in reversed(program.eqns):
        if used.intersection(equation.outvars):
            used |= {variable for variable in equation.invars if isinstance(variable, Var)}
    if used.intersection(program.invars):
        raise NotTraceable("random numbers or memory depend on it")


def _outcome(algorithm: Algorithm, spec: EnvSpec, key: Key[Array, ""]) -> PyTree:
    """One iteration on made-up observations: only its shapes are looked at."""
    count, length = spec.num_envs, algorithm.needs.rollout_length
    row = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape[1:])), example_observation(spec.observation_space))
    state = algorithm.init(key)
    actor, memory = algorithm.actor(state), algorithm.memory(count)
    noise = jax.tree.map(lambda x: x[0], algorithm.draw(key, 1))
    later, action, extras = algorithm.act(actor, memory, row, noise)
    decided = algorithm.greedy(actor, memory, row, noise)[:2]

    def through_time(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (length, *x.shape)), tree)

    rollout = Rollout(through_time(row), through_time(action), through_time(extras), through_time(_made_up_step(row, count)), memory)
    ways = (algorithm.update, algorithm.observe) if algorithm.needs.warmup_iterations else (algorithm.update,)
    return state, actor, later, decided, algorithm.value(actor, row), [way(state, rollout, key) for way in ways]


def _made_up_step(obs: Observation, count: int) -> Step:
    numbers, no = jnp.zeros((count,), jnp.float32), jnp.zeros((count,), bool)
    return Step(obs, obs, numbers, numbers, no, no, ~no)


def _same(found: PyTree, expected: PyTree) -> bool:
    leaves, others = jax.tree.leaves_with_path(found), jax.tree.leaves_with_path(expected)
    return len(leaves) == len(others) and all(
        (path, x.shape, x.dtype) == (place, y.shape, y.dtype) for (path, x), (place, y) in zip(leaves, others, strict=True)
    )


def _rate_in(value: object) -> float | Rate | None:
    """A schedule, or a number as text; None for other words."""
    if not isinstance(value, str):
        return None
    try:
        return parse_rate(value)
    except ValueError:
        return None
