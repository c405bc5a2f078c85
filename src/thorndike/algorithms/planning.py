"""Planning: exact values and policies of a finite task whose transition model is known.

Bellman, "Dynamic Programming" (1957): value iteration and finite horizons; Howard, "Dynamic Programming and Markov Processes" (1960):
policy iteration. Sutton and Barto (2nd edition, 2018), chapter 4. All in float64 NumPy: a sweep over Taxi takes some 30 microseconds.

Deviations and choices:
1. ``gamma = 1`` is exact: policies are evaluated only on states from which the task can end; where it never ends the value is 0 if no
   reward is left to collect, and an error if there is. Policy iteration starts from a policy that ends wherever one can, and changes an
   action only for a better one, so that it never walks into an endless loop.
2. A time limit (`finite_horizon`, or `steps` in `policy_evaluation`) cuts the episode: what comes after it is worth 0, as Gymnasium counts.

Logs nothing: it takes milliseconds. Measured results: docs/algorithms/planning.md.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from thorndike.environments.native.table import Table
from thorndike.errors import UserError
from thorndike.settings import AtLeast, Between, MoreThan, check

_BETTER = 1e-11


@dataclass(frozen=True)
class Config:
    """Settings of planning."""

    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount (gamma)
    method: Literal["value_iteration", "policy_iteration", "finite_horizon"] = "value_iteration"  # how to plan
    tolerance: Annotated[float, MoreThan(0)] = 1e-13  # value iteration stops when no value moves by more than this (theta)
    horizon: Annotated[int, AtLeast(1)] = 100  # steps of a finite horizon

    def __post_init__(self) -> None:
        """Raise UserError for a value out of bounds."""
        check(self)


class Solution(NamedTuple):
    """Values and the greedy policy. With a finite horizon, values and policy have a leading time axis; q_values are those of step 0."""

    values: Float[np.ndarray, "*time states"]
    q_values: Float[np.ndarray, "states actions"]
    policy: Int[np.ndarray, "*time states"]
    iterations: int
    residual: float
    """How much the last sweep changed a value."""

    def start_value(self, table: Table) -> float:
        """The expected return from the initial states."""
        return float(table.initial @ self.values.reshape(-1, len(table.initial))[0])


def plan(table: Table, config: Config) -> Solution:
    """Plan with the method that `config` names."""
    if config.method == "policy_iteration":
        return policy_iteration(table, config.gamma)
    if config.method == "finite_horizon":
        return finite_horizon(table, config.horizon, config.gamma)
    return value_iteration(table, config.gamma, config.tolerance)


def action_values(table: Table, values: Float[np.ndarray, " states"], gamma: float) -> Float[np.ndarray, "states actions"]:
    """One Bellman backup: ``Q(s, a) = sum_k p_k (r_k + gamma (1 - terminated_k) V(s'_k))``."""
    return _Model.of(table).backup(values, gamma)


def value_iteration(table: Table, gamma: float, tolerance: float = 1e-13, max_iterations: int = 1_000_000) -> Solution:
    """Sweep ``V <- max_a Q`` from 0 until no value moves by more than `tolerance` (Sutton and Barto, section 4.4).

    With gamma < 1 the values are then within ``tolerance * gamma / (1 - gamma)`` of the optimum, or of what float64 resolves. Raises
    UserError if `max_iterations` sweeps do not suffice: with gamma = 1, rewards that can be collected for ever.
    """
    model, values = _Model.of(table), np.zeros(len(table.initial))
    for iteration in range(1, max_iterations + 1):
        q_values = model.backup(values, gamma)
        swept = q_values.max(axis=1)
        residual = float(np.abs(swept - values).max())
        values = swept
        if residual <= max(tolerance, 4 * np.finfo(float).eps * float(np.abs(values).max())):
            return Solution(values, q_values, q_values.argmax(axis=1), iteration, residual)
    raise UserError(f"value iteration still moved by {residual:.3g} after {max_iterations} sweeps with gamma = {gamma}: lower gamma")


def policy_iteration(table: Table, gamma: float, max_iterations: int = 1_000) -> Solution:
    """Evaluate exactly, act greedily, repeat until nothing improves (Howard 1960; Sutton and Barto, section 4.3)."""
    model, policy = _Model.of(table), _ending_policy(table)
    for iteration in range(1, max_iterations + 1):
        values = policy_evaluation(table, policy, gamma)
        q_values = model.backup(values, gamma)
        best = q_values.argmax(axis=1)
        gain = q_values.max(axis=1) - np.take_along_axis(q_values, policy[:, None], axis=1)[:, 0]
        better = gain > _BETTER * np.maximum(1.0, np.abs(values))
        if not better.any():
            return Solution(values, q_values, policy, iteration, float(np.abs(gain).max()))
        policy = np.where(better, best, policy)
    raise UserError(f"policy iteration still improved after {max_iterations} rounds with gamma = {gamma}: lower gamma")


def policy_evaluation(
    table: Table, policy: Int[np.ndarray, " states"] | Float[np.ndarray, "states actions"], gamma: float, steps: int | None = None
) -> Float[np.ndarray, " states"]:
    """Values of a policy: one action a state, or probabilities of the actions. Exact (a linear system), or under a limit of `steps`.

    Raises UserError if gamma is 1 and the policy collects rewards for ever.
    """
    transition, reward = _under(table, policy)
    if steps is not None:
        values = np.zeros(len(reward))
        for _ in range(steps):
            values = reward + gamma * transition @ values
        return values
    alive = np.ones(len(reward), bool) if gamma < 1 else _can_end(transition)
    stuck = np.flatnonzero(~alive & (np.abs(reward) > 0))
    if len(stuck):
        raise UserError(
            f"with gamma = 1 the policy collects rewards for ever from state {stuck[0]}: lower gamma, or give a number of steps"
        )
    values = np.zeros(len(reward))
    inner = np.eye(int(alive.sum())) - gamma * transition[np.ix_(alive, alive)]
    values[alive] = np.linalg.solve(inner, reward[alive])
    return values


def finite_horizon(table: Table, steps: int, gamma: float = 1.0) -> Solution:
    """The best policy under a limit of `steps`, which depends on the time: backward induction (Bellman 1957).

    Returns values ``[steps + 1, states]`` and policy ``[steps, states]``: row t is for t steps already made; the last values are 0.
    """
    model = _Model.of(table)
    values, policy = np.zeros((steps + 1, len(table.initial))), np.zeros((steps, len(table.initial)), np.int64)
    q_values = np.zeros(table.probabilities.shape[:2])
    for step in reversed(range(steps)):
        q_values = model.backup(values[step + 1], gamma)
        values[step], policy[step] = q_values.max(axis=1), q_values.argmax(axis=1)
    return Solution(values, q_values, policy, steps, 0.0)


class _Model(NamedTuple):
    """A table made ready for many backups."""

    expected: Float[np.ndarray, "states actions"]
    weight: Float[np.ndarray, "states actions outcomes"]
    next_state: Int[np.ndarray, "states actions outcomes"]

    @classmethod
    def of(cls, table: Table) -> "_Model":
        expected = (table.probabilities * table.reward).sum(axis=2)
        return cls(expected, np.where(table.terminated, 0.0, table.probabilities), table.next_state.astype(np.int64))

    def backup(self, values: Float[np.ndarray, " states"], gamma: float) -> Float[np.ndarray, "states actions"]:
        return self.expected + gamma * np.einsum("sak,sak->sa", self.weight, values[self.next_state])


def _under(
    table: Table, policy: Int[np.ndarray, " states"] | Float[np.ndarray, "states actions"]
) -> tuple[Float[np.ndarray, "states states"], Float[np.ndarray, " states"]]:
    """Transition matrix among states that go on, and expected reward, of a policy."""
    model, (states, actions) = _Model.of(table), table.probabilities.shape[:2]
    chances = np.asarray(policy, np.float64) if np.ndim(policy) == 2 else np.eye(actions)[np.asarray(policy)]
    if chances.shape != (states, actions):
        raise UserError(
            f"a policy here is an action for each of {states} states or probabilities {(states, actions)}, not {np.shape(policy)}"
        )
    transition = np.zeros((states, states))
    np.add.at(transition, (np.arange(states)[:, None, None], model.next_state), chances[..., None] * model.weight)
    return transition, (chances * model.expected).sum(axis=1)


def _can_end(transition: Float[np.ndarray, "states states"]) -> Bool[np.ndarray, " states"]:
    """States from which the task ends with some probability."""
    able = transition.sum(axis=1) < 1 - 1e-12
    while True:
        more = able | (transition[:, able] > 0).any(axis=1)
        if (more == able).all():
            return able
        able = more


def _ending_policy(table: Table) -> Int[np.ndarray, " states"]:
    """A policy that brings the end nearer, with some probability, wherever any policy can."""
    possible = table.probabilities > 0
    able, policy = np.zeros(len(table.initial), bool), np.zeros(len(table.initial), np.int64)
    while True:
        helps = (possible & (table.terminated | able[table.next_state])).any(axis=2)
        fresh = helps.any(axis=1) & ~able
        if not fresh.any():
            return policy
        policy[fresh] = helps[fresh].argmax(axis=1)
        able |= fresh
