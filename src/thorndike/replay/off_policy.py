"""The part that all learners of continuous control have in common: act, store, and learn from what replay draws.

A learner brings a ``Method``; ``off_policy`` makes an ``Algorithm`` of it.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.functional.action_distributions import saturation
from thorndike.functional.coloured_noise import coloured_noise
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.schedules import schedule
from thorndike.replay.age import key_to_look_by
from thorndike.replay.hindsight import Hindsight, replay_for
from thorndike.replay.pace import pace
from thorndike.replay.replay import Ring
from thorndike.replay.uniform import Transitions, row_shapes
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Observation, Rollout


@runtime_checkable
class Settings(Protocol):
    """The settings that every ``Config`` of this family has."""

    @property
    def total_steps(self) -> int:
        """Environment steps of the run."""

    @property
    def learning_rate(self) -> float | str:
        """Step size of all optimisers, or a schedule."""

    @property
    def buffer_size(self) -> int:
        """Transitions kept."""

    @property
    def learning_starts(self) -> int:
        """Environment steps of uniform actions."""

    @property
    def batch_size(self) -> int:
        """Transitions of a minibatch."""

    @property
    def train_freq(self) -> int:
        """Environment steps between rounds of updates."""

    @property
    def gradient_steps(self) -> int:
        """Updates in a round; -1: one an environment step."""

    @property
    def gamma(self) -> float:
        """Discount."""

    @property
    def noise_color(self) -> float:
        """Of the exploration noise over time: 0 white, 1 pink, 2 red."""

    @property
    def net_arch(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""

    @property
    def activation(self) -> str:
        """After each hidden layer."""


@runtime_checkable
class Relabelling(Protocol):
    """The settings of those whose replay can tell what would have been right for another goal."""

    @property
    def goal_selection_strategy(self) -> str:
        """Where replay finds other goals: see ``hindsight.py``."""

    @property
    def n_sampled_goal(self) -> int:
        """Transitions with another goal for each one with its own."""


class Method(NamedTuple):
    """What tells one learner from another. Actions are ``[M, D]`` within [-1, 1]."""

    name: str
    dimensions: int
    """D: how many numbers an action has."""
    init: Callable[[Key[Array, ""]], PyTree]
    """key -> all that is learnt. Consumes the key."""
    acting: Callable[[PyTree], PyTree]
    """The learnt -> the part that acting and valuing need."""
    explore: Callable[[PyTree, Observation, Float[Array, "M D"] | Float[Array, "M H D"]], Float[Array, "M D"]]
    """acting part, obs, standard normal noise -> action while learning."""
    greedy: Callable[[PyTree, Observation], Float[Array, "M D"]]
    value: Callable[[PyTree, Observation], Float[Array, " M"]]
    draw: Callable[[Key[Array, ""], int], PyTree]
    """key, number of updates -> their random numbers, leading with the update. Consumes the key."""
    learn: Callable[[PyTree, Transitions, PyTree, Float[Array, ""], Int[Array, ""]], tuple[PyTree, Metrics]]
    """The learnt, a minibatch, random numbers of this update, learning rate, number of the update -> the learnt, metrics."""
    features: int = 0
    """H: above 0, exploration depends on the state; its noise is ``[M, H, D]`` and comes as ``HeldNoise``."""
    look: Callable[[PyTree, Transitions], Metrics] | None = None
    """The learnt, transitions -> dead units, effective rank, gradient norms of its networks."""


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: PyTree
    updates: Int[Array, ""]
    replay: PyTree
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    learnt: PyTree
    at_random: Bool[Array, ""]
    """Whether actions are uniform still: before ``learning_starts``."""


def repeated(
    one: Callable[[PyTree, Int[Array, ""]], tuple[PyTree, Metrics]], start: PyTree, times: int, always: Bool[Array, ""]
) -> tuple[PyTree, Metrics]:
    """``one(learnt, i)`` ``times`` times, and the mean of its metrics. ``always`` is a truth that the compiler cannot see through.

    With a number of rounds that it knows to be 1, XLA unrolls the loop, fuses what replay stores with what is sampled from it, and copies
    the whole replay to keep it as it was before (measured with 1,000,000 transitions: 10 ms a step).
    """
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(one, start, jnp.zeros((), jnp.int32))[1])

    def body(i: Int[Array, ""], carry: tuple[PyTree, Metrics]) -> tuple[PyTree, Metrics]:
        learnt, metrics = one(carry[0], i)
        return learnt, jax.tree.map(jnp.add, carry[1], metrics)

    learnt, totals = jax.lax.fori_loop(0, jnp.where(always, times, 0), body, (start, empty))
    return learnt, jax.tree.map(lambda total: total / times, totals)


def off_policy(method: Method, config: Settings, spec: EnvSpec) -> Algorithm:
    """An algorithm that learns from replayed transitions. Raises ``UserError`` where the settings do not fit together."""
    sizes = config.buffer_size, config.learning_starts, config.train_freq, config.gradient_steps
    plan = pace(method.name, *sizes, spec.num_envs)
    per_iteration = plan.rollout_length * spec.num_envs
    learning_rate = schedule(config.learning_rate)
    ring = Ring(row_shapes(spec), plan.ring_steps, spec.num_envs)
    hindsight = Hindsight("none", 0)
    if isinstance(config, Relabelling):
        hindsight = Hindsight(config.goal_selection_strategy, config.n_sampled_goal)
    noise_shape = (spec.num_envs, *((method.features,) if method.features else ()), method.dimensions)
    memory = replay_for(ring, config.batch_size, config.gamma, hindsight, spec)

    def init(key: Key[Array, ""]) -> State:
        return State(method.init(key), jnp.zeros((), jnp.int32), memory.init(), jnp.zeros((), jnp.int32))

    def actor(state: State) -> Actor:
        return Actor(method.acting(state.learnt), state.env_steps < config.learning_starts)

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: PyTree) -> tuple[PyTree, Float[Array, "B D"], PyTree]:
        smooth, white = (noise.held, noise.fresh[..., 0, :]) if method.features else (noise, noise)
        # The distribution function of the normal makes its noise uniform: no second draw.
        uniform = jax.scipy.special.erf(white * 0.5**0.5)
        return memory, jnp.where(actor.at_random, uniform, method.explore(actor.learnt, obs, smooth)), {}

    def observe(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        return state._replace(replay=memory.add(state.replay, rollout), env_steps=state.env_steps + per_iteration), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate = learning_rate(state.env_steps / config.total_steps)
        replay = memory.add(state.replay, rollout)
        # One key more than updates: from a single one the compiler would take the sampling out of the loop (see ``repeated``).
        keys = jax.random.split(key, plan.gradient_steps + 1)
        drawn = method.draw(keys[-1], plan.gradient_steps)

        def one(learnt: PyTree, i: Int[Array, ""]) -> tuple[PyTree, Metrics]:
            noise = jax.tree.map(lambda x: x[i], drawn)
            batch = memory.sample(replay, keys[i], jnp.ones(())).batch
            after, metrics = method.learn(learnt, batch, noise, rate, state.updates + i)
            return accept_if(all_finite(*metrics.values()), after, learnt), metrics

        learnt, metrics = repeated(one, state.learnt, plan.gradient_steps, state.updates >= 0)
        updates, metrics["train/learning_rate"] = state.updates + plan.gradient_steps, rate
        metrics |= saturation(spec.action_space, rollout.action)
        return State(learnt, updates, replay, state.env_steps + per_iteration), metrics

    def dynamics(state: State, rollout: PyTree) -> Metrics:
        del rollout
        batch = memory.sample(state.replay, key_to_look_by(state.env_steps), jnp.ones(())).batch
        networks = {} if method.look is None else method.look(state.learnt, batch)
        return networks if memory.age is None else networks | {"train/replay_age": memory.age(state.replay)}

    return Algorithm(
        init=init,
        actor=actor,
        memory=lambda batch: (),
        draw=lambda key, steps: coloured_noise(key, steps, noise_shape, config.noise_color),
        act=act,
        greedy=lambda actor, memory, obs, noise: (memory, method.greedy(actor.learnt, obs), {}),
        value=lambda actor, obs: method.value(actor.learnt, obs),
        update=update,
        observe=observe,
        needs=Needs(rollout_length=plan.rollout_length, on_policy=False, warmup_iterations=plan.warmup_iterations),
        dynamics=dynamics,
    )
