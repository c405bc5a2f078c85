"""Tabular Q-learning and its relatives: one action value for every state and action, learnt one step at a time.

Papers: Watkins, "Learning from Delayed Rewards" (PhD thesis, 1989): Q-learning, Q(lambda); Rummery and Niranjan, "On-Line Q-Learning
Using Connectionist Systems" (CUED/F-INFENG/TR 166, 1994): SARSA; van Seijen et al., "A Theoretical and Empirical Analysis of Expected
Sarsa" (ADPRL 2009); van Hasselt, "Double Q-learning" (NeurIPS 2010). All are in Sutton and Barto (2018), chapters 6 and 12. Deviations:

1. The rows of a batch are learnt one after another, in the order of time and then of environments, each from the table that the one before
   left: B environments that meet in the same (s, a) count as B successive steps. Nothing is summed, averaged or lost.
2. A time limit is no end: the target bootstraps from the true successor. SARSA, which takes no action there, uses the expected value.
3. SARSA learns a transition one step later, when its next action is known: the order of Sutton and Barto. A run's last one is not learnt.
4. One random number a step decides whether to explore and which action to take; ties between best actions are broken at random.
5. Q(lambda) is Watkins's, with replacing traces over the whole table: one step costs O(states x actions).

Logs ``rollout/exploration_rate``, ``train/learning_rate``, ``train/td_error`` (mean absolute). Results: docs/algorithms/q_learning.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from gymnasium.spaces import Discrete
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.exploration import Exploration, explore
from thorndike.functional.row_by_row import row_by_row
from thorndike.functional.schedules import Rate, schedule
from thorndike.functional.state_index import state_index
from thorndike.functional.temporal_difference import double_q_target, expected_sarsa_target, q_learning_target, sarsa_target, select
from thorndike.functional.traces import Place, watkins
from thorndike.settings import AtLeast, Between, MoreThan, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of tabular Q-learning."""

    total_steps: Annotated[int, Between(1, 2**31 - 1)]  # environment steps of the whole run, against which schedules are measured
    variant: Literal["q_learning", "sarsa", "expected_sarsa", "double_q", "q_lambda"] = "q_learning"  # which target is learnt
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount (gamma)
    learning_rate: Annotated[float | str, Between(0, 1)] = 0.1  # step size (alpha), or a schedule such as linear(0.1, 0.001)
    visits_power: Annotated[float, Between(0, 1)] = 0.0  # the step size is divided by visits(s, a) ** this; 0: not at all
    trace_decay: Annotated[float, Between(0, 1)] = 0.9  # decay of eligibility traces (lambda), for q_lambda
    exploration_initial_eps: Annotated[float, Between(0, 1)] = 1.0  # chance of a random action at the start (epsilon)
    exploration_final_eps: Annotated[float, Between(0, 1)] = 0.05  # the floor of epsilon
    exploration_fraction: Annotated[float, MoreThan(0), Between(0, 1)] = 0.5  # part of the run over which epsilon falls linearly
    exploration_decay: Annotated[float | None, Between(0, 1)] = None  # instead: epsilon is multiplied by this after every episode
    exploration: Literal["epsilon", "boltzmann", "ucb"] = "epsilon"  # random actions, by exp(Q / temperature), or by optimism
    temperature: Annotated[float | str, MoreThan(0)] = "linear(1, 0.01)"  # of boltzmann (tau)
    ucb_coefficient: Annotated[float, AtLeast(0)] = 1.0  # of ucb: c in Q + c sqrt(ln N(s) / N(s, a))
    initial_value: float = 0.0  # every action value at the start; optimistic values explore
    random_ties: bool = True  # whether ties between best actions are broken at random
    n_steps: Annotated[int, AtLeast(1)] = 1  # steps of each environment between two updates

    def __post_init__(self) -> None:
        """Raise UserError for a value out of bounds, or a target that values another policy than the one that acts."""
        check(self)
        if self.exploration != "epsilon" and self.variant in ("sarsa", "expected_sarsa"):
            raise UserError(f"q_learning: {self.variant} values epsilon-greedy actions: set exploration to epsilon, not {self.exploration}")


class Tables(NamedTuple):
    """What is learnt. A second table only for double Q, visits only if they set the step size, traces only for Q(lambda)."""

    q: Float[Array, "states tables*actions"]
    visits: PyTree[Int[Array, "states actions"]]
    traces: PyTree[Float[Array, "envs states actions"]]


class Transition(NamedTuple):
    """What happened, by state numbers."""

    state: Int[Array, "*rows"]
    action: Int[Array, "*rows"]
    reward: Float[Array, "*rows"]
    next_state: Int[Array, "*rows"]
    terminated: Bool[Array, "*rows"]
    done: Bool[Array, "*rows"]
    valid: Bool[Array, "*rows"]


class Row(NamedTuple):
    """All that one update of the tables needs."""

    env: Int[Array, "*rows"]
    transition: Transition
    next_action: Int[Array, "*rows"]
    greedy: Bool[Array, "*rows"]
    coin: Bool[Array, "*rows"]
    epsilon: Float[Array, "*rows"]
    rate: Float[Array, "*rows"]


class State(NamedTuple):
    """The learner; ``epsilon`` is the chance of a random action where it falls by episodes."""

    tables: Tables
    pending: PyTree
    """SARSA's last transition of each environment, waiting for its next action."""
    epsilon: Float[Array, ""]
    iteration: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs; ``epsilon`` is the temperature of Boltzmann exploration."""

    q: Float[Array, "states tables*actions"]
    epsilon: Float[Array, ""]
    visits: PyTree[Int[Array, "states actions"]]


class Extras(NamedTuple):
    """What `act` tells `update`."""

    greedy: Bool[Array, "*batch"]
    coin: Bool[Array, "*batch"]
    """Double Q: which table learns."""


Draws: TypeAlias = tuple[Float[Array, "*batch"], Bool[Array, "*batch"]]  # epsilon-greedy's number in [0, 1), double Q's coin


def q_learning(config: Config, spec: EnvSpec) -> Algorithm:
    """Build the learner. Raises UserError for continuous observations or actions, or a table of more than 2**28 entries."""
    if not isinstance(spec.action_space, Discrete):
        raise UserError(f"q_learning needs Discrete actions, but {spec.id} has {spec.action_space}; ppo takes those")
    (states, number), actions = state_index(spec.observation_space), int(spec.action_space.n)
    if states * actions > 2**28:
        raise UserError(f"q_learning would need a table of {states} states x {actions} actions for {spec.id}: use fewer bins, or dqn")
    learn, rate = row_by_row(_learner(config, (states, actions, spec.num_envs))), schedule(config.learning_rate)
    last_iteration = max(config.total_steps // (config.n_steps * spec.num_envs), 1)
    double, sarsa, ucb = config.variant == "double_q", config.variant == "sarsa", config.exploration == "ucb"
    how = Exploration(config.exploration, config.ucb_coefficient, config.random_ties)

    def init(key: Key[Array, ""]) -> State:
        kinds = (jnp.int32, jnp.int32, jnp.float32, jnp.int32, jnp.bool, jnp.bool, jnp.bool)
        pending = Transition(*(jnp.zeros(spec.num_envs, kind) for kind in kinds)) if sarsa else ()
        epsilon = jnp.array(config.exploration_initial_eps, jnp.float32)
        return State(_first_tables(config, states, actions, spec.num_envs), pending, epsilon, jnp.array(0, jnp.int32))

    def progress(state: State) -> Float[Array, ""]:
        return state.iteration / jnp.float32(last_iteration)

    def draw(key: Key[Array, ""], steps: int) -> Draws:
        shape, (key_explore, key_coin) = (steps, spec.num_envs), jax.random.split(key)
        coin = jax.random.bernoulli(key_coin, 0.5, shape) if double else jnp.zeros(shape, bool)
        return jax.random.uniform(key_explore, shape), coin

    def values(actor: Actor, obs: PyTree) -> Float[Array, "*batch actions"]:
        row = actor.q.at[number(obs)].get(mode="promise_in_bounds")
        return (row[..., :actions] + row[..., actions:]) / 2.0 if double else row

    def act(actor: Actor, memory: PyTree, obs: PyTree, noise: Draws) -> tuple[PyTree, Int[Array, "*batch"], Extras]:
        choice = explore(how, values(actor, obs), actor.epsilon, actor.visits[number(obs)] if ucb else (), noise[0])
        return memory, choice.action, Extras(choice.greedy, noise[1])

    def greedy(actor: Actor, memory: PyTree, obs: PyTree, noise: Draws) -> tuple[PyTree, Int[Array, "*batch"], Extras]:
        action = values(actor, obs).argmax(axis=-1).astype(jnp.int32)
        return memory, action, Extras(jnp.ones_like(action, bool), noise[1])

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        step, action, pending = rollout.step, rollout.action.astype(jnp.int32), state.pending
        transition = Transition(number(rollout.obs), action, step.reward, number(step.next_obs), step.terminated, step.done, step.valid)
        if sarsa:
            delayed = jax.tree.map(lambda old, new: jnp.concatenate([old[None], new[:-1]]), pending, transition)
            transition, pending = delayed, jax.tree.map(lambda new: new[-1], transition)
        epsilon, alpha = _epsilon(config, state.epsilon, progress(state)), rate(progress(state))
        each, extras = partial(jnp.broadcast_to, shape=transition.state.shape), rollout.extras
        rows = Row(each(jnp.arange(spec.num_envs)), transition, action, extras.greedy, extras.coin, each(epsilon), each(alpha))
        tables, errors = learn(state.tables, jax.tree.map(jnp.ravel, rows))
        decay = 1.0 if config.exploration_decay is None else config.exploration_decay
        fallen = jnp.maximum(state.epsilon * jnp.where(step.done & step.valid, decay, 1.0).prod(), config.exploration_final_eps)
        metrics = {"rollout/exploration_rate": epsilon, "train/learning_rate": alpha, "train/td_error": errors.mean()}
        return State(tables, pending, fallen, jnp.minimum(state.iteration + 1, last_iteration)), metrics

    return Algorithm(
        init=init,
        actor=lambda now: Actor(now.tables.q, _epsilon(config, now.epsilon, progress(now)), now.tables.visits if ucb else ()),
        memory=lambda batch: (),
        draw=draw,
        act=act,
        greedy=greedy,
        value=lambda actor, obs: values(actor, obs).max(axis=-1),
        update=update,
        observe=lambda state, rollout, key: (state, {}),
        needs=Needs(rollout_length=config.n_steps, on_policy=sarsa),
    )


def _first_tables(config: Config, states: int, actions: int, num_envs: int) -> Tables:
    q = jnp.full((states, actions * (2 if config.variant == "double_q" else 1)), config.initial_value, jnp.float32)
    visits = jnp.zeros((states, actions), jnp.int32) if config.visits_power > 0 or config.exploration == "ucb" else ()
    return Tables(q, visits, jnp.zeros((num_envs, states, actions), jnp.float32) if config.variant == "q_lambda" else ())


def _epsilon(config: Config, by_episodes: Float[Array, ""], progress: Float[Array, ""]) -> Float[Array, ""]:
    if config.exploration != "epsilon":
        return schedule(config.temperature if config.exploration == "boltzmann" else 0.0)(progress)
    if config.exploration_decay is not None:
        return by_episodes
    return schedule(Rate("linear", config.exploration_initial_eps, config.exploration_final_eps, config.exploration_fraction))(progress)


def _learner(config: Config, sizes: tuple[int, int, int]) -> Callable[[Tables, Int[Array, ""], Row], tuple[Tables, Float[Array, ""]]]:
    """One row: tables -> tables, absolute error. Only slices at scalar positions, so that XLA updates in place, in one kernel."""
    states, actions, num_envs = sizes

    def learn_row(tables: Tables, seed: Int[Array, ""], row: Row) -> tuple[Tables, Float[Array, ""]]:
        now, first = row.transition, seed * states
        state, successor, column = first + now.state, first + now.next_state, row.coin * actions + now.action
        # A masked sum, because XLA keeps a sum in one place: a slice read again after the update would make it copy the table every step.
        value = select(lax.dynamic_index_in_dim(tables.q, state, keepdims=False), column)
        target = _target(config, row, lax.dynamic_index_in_dim(tables.q, successor, keepdims=False))
        error = jnp.where(now.valid, target - value, 0.0)
        # What is not finite is reported but not learnt: the table stays good.
        learnt, rate, visits = jnp.where(jnp.isfinite(error), error, 0.0), row.rate, tables.visits
        if config.visits_power > 0 or config.exploration == "ucb":
            count = select(lax.dynamic_index_in_dim(visits, state, keepdims=False), now.action) + now.valid
            visits = lax.dynamic_update_slice(visits, count[None, None], (state, now.action))
            rate = rate * jnp.maximum(count, 1).astype(jnp.float32) ** -config.visits_power
        if config.variant == "q_lambda":
            place = Place(first, seed * num_envs + row.env, now.state, now.action)
            fading, kept = jnp.where(row.greedy, config.gamma * config.trace_decay, 0.0), jnp.where(now.done | ~now.valid, 0.0, 1.0)
            q, traces = watkins(tables.q, tables.traces, place, rate * learnt, fading, kept)
            return Tables(q, visits, traces), jnp.abs(error)
        q = lax.dynamic_update_slice(tables.q, (value + rate * learnt)[None, None], (state, column))
        return Tables(q, visits, ()), jnp.abs(error)

    return learn_row


def _target(config: Config, row: Row, next_q: Float[Array, "tables*actions"]) -> Float[Array, ""]:
    outcome = row.transition.reward, row.transition.terminated
    match config.variant:
        case "sarsa":
            expected = expected_sarsa_target(*outcome, next_q, row.epsilon, config.gamma)
            return jnp.where(row.transition.done, expected, sarsa_target(*outcome, next_q, row.next_action, config.gamma))
        case "expected_sarsa":
            return expected_sarsa_target(*outcome, next_q, row.epsilon, config.gamma)
        case "double_q":
            first, second = jnp.split(next_q, 2)
            return double_q_target(*outcome, jnp.where(row.coin, second, first), jnp.where(row.coin, first, second), config.gamma)
        case _:
            return q_learning_target(*outcome, next_q, config.gamma)
