"""The part that all learners from datasets have in common: a minibatch after another, and no environment.

A learner brings a ``Method``, as those of continuous control do; ``offline`` makes an ``Algorithm`` of it. Where actions are Discrete, a
method's actions are whole numbers ``[M]``, and ``dimensions`` is how many normal numbers it takes to explore.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.schedules import schedule
from thorndike.replay.off_policy import Actor, Method, repeated
from thorndike.replay.uniform import Transitions
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Number, Observation, Rollout

UPDATES_OF_AN_ITERATION = 10


@runtime_checkable
class Settings(Protocol):
    """The settings that every ``Config`` of this family has."""

    @property
    def total_steps(self) -> int:
        """Updates of the run."""

    @property
    def learning_rate(self) -> float | str:
        """Step size of all optimisers, or a schedule."""

    @property
    def batch_size(self) -> int:
        """Transitions of a minibatch."""

    @property
    def net_arch(self) -> tuple[int, ...]:
        """Widths of the hidden layers."""

    @property
    def activation(self) -> str:
        """After each hidden layer."""


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: PyTree
    updates: Int[Array, ""]


def minibatches_of(rollout: Rollout, gamma: Number) -> Transitions:
    """A dataset's rollout ``[T, M]`` as T minibatches; a step cut by a limit bootstraps, one that terminated does not."""
    step = rollout.step
    discount = jnp.where(step.terminated, 0.0, gamma)
    return Transitions(rollout.obs, rollout.action, step.reward, step.next_obs, discount, step.valid.astype(jnp.float32))


def offline(
    method: Method,
    config: Settings,
    spec: EnvSpec,
    gamma: Number,
    probabilities: Callable[[PyTree, Observation], Float[Array, "M A"]] | None = None,
) -> Algorithm:
    """An algorithm that learns from a dataset's minibatches. ``probabilities``: acting part, obs -> those of each Discrete action."""
    learning_rate = schedule(config.learning_rate)

    def init(key: Key[Array, ""]) -> State:
        return State(method.init(key), jnp.zeros((), jnp.int32))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Float[Array, "B D"]) -> tuple[PyTree, PyTree, PyTree]:
        return memory, method.explore(actor.learnt, obs, noise), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate, count = learning_rate(state.updates / config.total_steps), rollout.step.reward.shape[0]
        batches, drawn = minibatches_of(rollout, gamma), method.draw(key, count)

        def one(learnt: PyTree, i: Int[Array, ""]) -> tuple[PyTree, Metrics]:
            batch, noise = jax.tree.map(lambda x: x[i], (batches, drawn))
            after, metrics = method.learn(learnt, batch, noise, rate, state.updates + i)
            return accept_if(all_finite(*metrics.values()), after, learnt), metrics

        learnt, metrics = repeated(one, state.learnt, count, state.updates >= 0)
        return State(learnt, state.updates + count), metrics | {"train/learning_rate": rate}

    def dynamics(state: State, rollout: Rollout) -> Metrics:
        first = jax.tree.map(lambda x: x[0], minibatches_of(rollout, gamma))
        return {} if method.look is None else method.look(state.learnt, first)

    return Algorithm(
        init=init,
        actor=lambda state: Actor(method.acting(state.learnt), jnp.zeros((), jnp.bool_)),
        memory=lambda batch: (),
        draw=lambda key, steps: jax.random.normal(key, (steps, spec.num_envs, method.dimensions)),
        act=act,
        greedy=lambda actor, memory, obs, noise: (memory, method.greedy(actor.learnt, obs), {}),
        value=lambda actor, obs: method.value(actor.learnt, obs),
        update=update,
        observe=lambda state, rollout, key: (state, {}),
        needs=Needs(rollout_length=UPDATES_OF_AN_ITERATION, on_policy=False, batch_size=config.batch_size),
        probabilities=None if probabilities is None else lambda actor, memory, obs: probabilities(actor.learnt, obs),
        dynamics=None if method.look is None else dynamics,
    )
