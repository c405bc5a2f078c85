"""Any finite environment with a transition table, compiled from it: FrozenLake of any map, CliffWalking, Taxi, or one's own.

``read_table`` reads ``unwrapped.P`` and ``initial_state_distrib`` of a Gymnasium environment, with the step limit of its spec.
``table_dynamics`` compiles it. State and observation are ``int32[...]``.

Speed: the outcome of a step is chosen outside the scan. The cumulative probabilities of all (state, action) pairs cut [0, 1) into a
few intervals (three for a slippery lake); within one, every pair has one fixed outcome. So the noise of a step is the number of its
interval, and a step is one look-up of a packed successor and one of the reward. A table whose pairs cut too finely falls back to
comparing with the pair's own cumulative probabilities inside the scan. A deterministic table draws nothing for a step, a single start
state nothing for a reset.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces, wrappers
from jaxtyping import Array, Bool, Float, Int32, Key

from thorndike.environments.native.randomness import draw_words, no_noise, unit_interval
from thorndike.environments.native.vectorize import Dynamics
from thorndike.errors import UserError
from thorndike.types import Noise

MAX_ENTRIES = 2**20
"""Largest look-up table (states x actions x intervals): 8 MiB."""

PLAIN_WRAPPERS = (wrappers.TimeLimit, wrappers.OrderEnforcing, wrappers.PassiveEnvChecker)
"""The wrappers of ``gymnasium.make``, which leave transitions and rewards as they are."""

Outcomes: TypeAlias = Sequence[tuple]
Draw: TypeAlias = Callable[[Key[Array, ""], tuple[int, ...]], Noise]
Choose: TypeAlias = Callable[[Int32[Array, "*batch"], Noise], Int32[Array, "*batch"]]


class Table(NamedTuple):
    """The transition model of a finite task: S states, A actions, at most K outcomes of each pair (padded with probability 0)."""

    probabilities: Float[np.ndarray, "S A K"]
    next_state: Int32[np.ndarray, "S A K"]
    reward: Float[np.ndarray, "S A K"]
    terminated: Bool[np.ndarray, "S A K"]
    initial: Float[np.ndarray, " S"]
    id: str = "table"
    max_episode_steps: int | None = None


def has_table(environment: gymnasium.Env) -> bool:
    """Whether ``read_table`` can read this environment."""
    return not _obstacle(environment)


def read_table(environment: gymnasium.Env) -> Table:
    """The transition table of a Gymnasium environment that carries one, with the step limit of its spec.

    Raises UserError if there is none, or one that does not describe the environment.
    """
    spec = environment.spec
    name = type(environment.unwrapped).__name__ if spec is None else spec.id
    if obstacle := _obstacle(environment):
        raise UserError(f"{name} cannot be read as a transition table: {obstacle}")
    unwrapped = environment.unwrapped
    model: Mapping[int, Mapping[int, Outcomes]] = unwrapped.get_wrapper_attr("P")
    initial = np.asarray(unwrapped.get_wrapper_attr("initial_state_distrib"), np.float64)
    limit = None if spec is None else spec.max_episode_steps
    return _dense(model, initial, name)._replace(id=name, max_episode_steps=limit)


def table_dynamics(table: Table) -> Dynamics:
    """The compiled environment of a table."""
    states, actions, _ = table.probabilities.shape
    starts = np.flatnonzero(table.initial)
    draw_outcome, choose, intervals = _outcomes(table)
    packed, rewards = _look_up(table, intervals)
    draw_start = _categorical(np.cumsum(table.initial[starts]))

    def draw_reset(key: Key[Array, ""], shape: tuple[int, ...]) -> Noise:
        return () if len(starts) == 1 else jnp.asarray(starts, jnp.int32)[draw_start(key, shape)]

    def reset(noise: Noise) -> Int32[Array, "*batch"]:
        return jnp.int32(starts[0]) if len(starts) == 1 else noise

    def step(
        state: Int32[Array, "*batch"], action: Int32[Array, "*batch"], noise: Noise
    ) -> tuple[Int32[Array, "*batch"], Float[Array, "*batch"], Bool[Array, "*batch"]]:
        entry = choose(state * actions + action, noise)
        outcome = _at(packed, entry)
        return outcome >> 1, _at(rewards, entry), (outcome & 1) == 1

    return Dynamics(
        reset=reset,
        observe=lambda state: state,
        step=step,
        draw_reset=draw_reset,
        draw_step=draw_outcome,
        observation_space=spaces.Discrete(states),
        action_space=spaces.Discrete(actions),
        id=table.id,
        max_episode_steps=table.max_episode_steps,
    )


def _obstacle(environment: gymnasium.Env) -> str:
    """What keeps the environment from being its table, and the way round it; empty if nothing."""
    unwrapped = environment.unwrapped
    if not isinstance(getattr(unwrapped, "P", None), Mapping) or not hasattr(unwrapped, "initial_state_distrib"):
        return "it lacks the attributes P and initial_state_distrib: give it both, or use a learner on a host engine"
    if getattr(unwrapped, "fickle_passenger", False):
        return "its P leaves out the fickle passenger: make it with fickle_passenger=False, or use a host engine"
    if unwrapped.observation_space != spaces.Discrete(len(unwrapped.get_wrapper_attr("P"))):
        return f"its observation is not the number of its state but {unwrapped.observation_space}: use a host engine"
    wrapper = environment
    while isinstance(wrapper, gymnasium.Wrapper):
        if not isinstance(wrapper, PLAIN_WRAPPERS):
            return f"its wrapper {type(wrapper).__name__} may change what P says: pass the environment without it, or use a host engine"
        wrapper = wrapper.env
    return ""


def _dense(model: Mapping[int, Mapping[int, Outcomes]], initial: Float[np.ndarray, " S"], name: str) -> Table:
    """Gymnasium's ``P[state][action] = [(probability, next state, reward, terminated), ...]`` as arrays."""
    shape = (len(model), len(model[0]), max(len(outcomes) for row in model.values() for outcomes in row.values()))
    table = Table(np.zeros(shape), np.zeros(shape, np.int32), np.zeros(shape), np.zeros(shape, np.bool_), initial)
    for state, action in np.ndindex(shape[:2]):
        outcomes = model[state][action]
        for column, values in zip(table[:4], zip(*outcomes, strict=True), strict=True):
            column[state, action, : len(outcomes)] = values
    worst = np.abs(table.probabilities.sum(axis=2) - 1).max()
    if worst > 1e-6 or abs(initial.sum() - 1) > 1e-6 or len(initial) != shape[0]:
        raise UserError(
            f"the probabilities of {name} must sum to 1 for each state and action and for its {shape[0]} initial states; "
            f"they are off by up to {max(worst, abs(initial.sum() - 1)):.2g}: correct P or initial_state_distrib"
        )
    return table


def _outcomes(table: Table) -> tuple[Draw, Choose, Float[np.ndarray, " M"] | None]:
    """How a step finds its entry in the look-up table: the draw, the choice (row, noise -> entry), and the common intervals' ends."""
    cumulative = np.cumsum(table.probabilities, axis=2)
    ends = np.unique(np.append(cumulative[cumulative < 1 - 1e-9].round(12), 1.0))
    ends = ends[ends > 0]
    pairs, outcomes = cumulative[..., 0].size, cumulative.shape[2]
    if len(ends) == 1:
        return no_noise, lambda row, noise: row, ends
    if len(ends) * pairs <= MAX_ENTRIES:
        return _categorical(ends), lambda row, noise: row * len(ends) + noise, ends
    thresholds = jnp.asarray(cumulative.reshape(pairs, outcomes), jnp.float32)

    def choose(row: Int32[Array, "*batch"], noise: Noise) -> Int32[Array, "*batch"]:
        passed = unit_interval(noise)[..., None] >= _at(thresholds, row)[..., :-1]
        return row * outcomes + jnp.sum(passed, axis=-1, dtype=jnp.int32)

    return draw_words, choose, None


def _look_up(table: Table, ends: Float[np.ndarray, " M"] | None) -> tuple[Int32[Array, " n"], Float[Array, " n"]]:
    """Successors, packed with ``terminated`` in the lowest bit, and rewards, by entry (pair x interval, or pair x outcome)."""
    packed = table.next_state.astype(np.int32) * 2 + table.terminated
    rewards = table.reward
    if ends is not None:
        middles = ends - np.diff(ends, prepend=0.0) / 2
        cumulative = np.cumsum(table.probabilities, axis=2)
        outcome = (middles[:, None] >= cumulative[:, :, None, :-1]).sum(axis=3)
        packed, rewards = (np.take_along_axis(values, outcome, axis=2) for values in (packed, rewards))
    return jnp.asarray(packed.reshape(-1), jnp.int32), jnp.asarray(rewards.reshape(-1), jnp.float32)


def _categorical(ends: Float[np.ndarray, " n"]) -> Draw:
    """Draws the number of the interval of [0, 1) that a uniform number falls in; ``ends`` are the intervals' upper ends."""
    count = len(ends)
    even = bool(np.allclose(ends, np.arange(1, count + 1) / count, rtol=0, atol=1e-9))

    def draw(key: Key[Array, ""], shape: tuple[int, ...]) -> Int32[Array, "..."]:
        number = unit_interval(jax.random.bits(key, shape, jnp.uint32))
        if even:
            return (number * count).astype(jnp.int32)
        return jnp.searchsorted(jnp.asarray(ends[:-1], jnp.float32), number, side="right").astype(jnp.int32)

    return draw


def _at(values: Array, index: Int32[Array, "*batch"]) -> Array:
    """Rows of ``values``, without the checks for negative indices that would double the cost of a step."""
    return values.at[index].get(mode="promise_in_bounds")
