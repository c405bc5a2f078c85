"""Hindsight experience replay (HER): transitions replayed as if what was achieved later had been the goal all along.

Andrychowicz et al. 2017 (arXiv:1707.01495). The new goal is drawn when a transition is drawn, so the memory holds nothing twice: beside
the ring there are, for each row, the step its episode began at, and at the first row of each episode, its last step so far. A draw costs
three gathers more, whatever the ring's size. Deviations from the paper:

1. A transition is relabelled with probability ``k / (k + 1)`` each time it is drawn, as in Stable-Baselines3, in place of ``k`` copies.
2. An episode under way is relabelled too; its last step is then the newest one. One whose beginning has been overwritten is not.
3. Where reaching the goal ends an episode, it ends the relabelled one; an end for another reason stays. A time limit never is an end.
"""

from functools import partial
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.replay.age import mean_age
from thorndike.replay.prioritized import Draw
from thorndike.replay.replay import Replay, Ring, uniform_replay
from thorndike.replay.uniform import ReplayBuffer, Transitions, add, drawn_rows, init_replay, transitions_at
from thorndike.types import EnvSpec, Goal, Number, Rollout

STRATEGIES = ("none", "future", "final", "episode")
"""Where the new goal is from, by Stable-Baselines3's names: a later step of the episode (or this one), its last, any of its steps."""
GOAL_PARTS = ("observation", "achieved_goal", "desired_goal")


class Hindsight(NamedTuple):
    """How goals are replaced."""

    strategy: str
    n_sampled_goal: Number
    """k: relabelled transitions for each one that keeps its goal."""


class HindsightReplay(NamedTuple):
    """The ring, and where its episodes begin and end. Steps are counted from the start of the run, row ``t % N`` of the ring holds one."""

    ring: ReplayBuffer
    began: Int[Array, " rows"]
    """The first step of each row's episode."""
    last: Int[Array, " rows"]
    """At the row of an episode's first step: its last one stored so far."""
    under_way: Int[Array, " B"]
    """The first step of each environment's present episode."""
    written: Int[Array, ""]
    """Steps stored in all."""


def replay_for(ring: Ring, batch_size: int, gamma: Number, hindsight: Hindsight, spec: EnvSpec) -> Replay:
    """A uniform memory, with hindsight if its strategy is not ``none``. Raises ``UserError`` if the environment has no goals."""
    if hindsight.strategy == "none":
        return uniform_replay(ring, batch_size, 1, gamma)
    space = spec.observation_space
    if not isinstance(space, gymnasium.spaces.Dict) or not set(GOAL_PARTS) <= set(space.spaces):
        raise UserError(
            f"goal_selection_strategy={hindsight.strategy} needs observations that are a Dict with {', '.join(GOAL_PARTS)}; {spec.id} has "
            f"{space}: set it to none"
        )

    def draw(replay: HindsightReplay, key: Key[Array, ""], beta: Float[Array, ""]) -> Draw:
        del beta
        batch = sample_hindsight(replay, key, batch_size, ring.num_envs, gamma, hindsight, goal_of(spec))
        return Draw(batch, jnp.zeros((0,), jnp.int32), jnp.ones((batch_size,), jnp.float32))

    return Replay(
        partial(init_hindsight, *ring),
        add_hindsight,
        draw,
        lambda replay, draw, errors: replay,
        age=lambda replay: mean_age(replay.ring, ring.num_envs),
    )


def goal_of(spec: EnvSpec) -> Goal:
    """How the environment judges goals. Raises ``UserError`` where a compiled program cannot."""
    if spec.goal is None:
        raise UserError(
            f"hindsight recomputes rewards inside the compiled program: {spec.id} must be a native goal environment, reward a distance "
            "or a threshold of it as Gymnasium-robotics does, or write compute_reward with jax.numpy; set goal_selection_strategy to none"
        )
    return spec.goal


def init_hindsight(row: PyTree, steps: int, num_envs: int) -> HindsightReplay:
    """An empty memory for ``steps`` steps of ``num_envs`` environments, of transitions shaped as ``row`` (see ``row_shapes``)."""
    began, last = jnp.zeros((2, steps * num_envs), jnp.int32)
    return HindsightReplay(init_replay(row, steps, num_envs), began, last, jnp.zeros((num_envs,), jnp.int32), jnp.zeros((), jnp.int32))


def add_hindsight(replay: HindsightReplay, rollout: Rollout) -> HindsightReplay:
    """Write ``T`` steps over the oldest ones. The number of steps in the ring must be a multiple of ``T``."""
    length, num_envs = rollout.step.reward.shape
    steps = replay.began.shape[0] // num_envs
    number = replay.written + jnp.arange(length, dtype=jnp.int32)
    ended = rollout.step.done | ~rollout.step.valid
    fresh = jnp.where(ended, number[:, None] + 1, 0)
    # The first step of each row's episode: the latest beginning before it.
    begins = jax.lax.cummax(jnp.concatenate([replay.under_way[None], fresh]), axis=0)
    began = jax.lax.dynamic_update_slice_in_dim(replay.began, begins[:-1].ravel(), replay.ring.position * num_envs, axis=0)
    first_rows = (begins[:-1] % steps) * num_envs + jnp.arange(num_envs, dtype=jnp.int32)[None]
    # The largest: later steps of this rollout, and all of them over those of an episode that the ring has forgotten.
    ends = jnp.broadcast_to(number[:, None], begins[:-1].shape).ravel()
    last = replay.last.at[first_rows.ravel()].max(ends, mode="promise_in_bounds")
    return HindsightReplay(add(replay.ring, rollout), began, last, begins[-1], replay.written + length)


def sample_hindsight(
    replay: HindsightReplay, key: Key[Array, ""], batch_size: int, num_envs: int, gamma: Number, hindsight: Hindsight, goal: Goal
) -> Transitions:
    """Draw ``batch_size`` transitions uniformly, ``k`` of ``k + 1`` of them with another goal and its reward. Consumes the key."""
    key_rows, key_goals = jax.random.split(key)
    index = drawn_rows(replay.ring, key_rows, batch_size, num_envs, 1)
    batch = transitions_at(replay.ring, index, num_envs, 1, gamma)
    steps, env = replay.began.shape[0] // num_envs, index % num_envs
    number = replay.written - 1 - (replay.ring.position - 1 - index // num_envs) % steps
    first = replay.began[index]
    last = replay.last[(first % steps) * num_envs + env]
    chosen = _chosen_step(hindsight.strategy, first, number, last, jax.random.uniform(key_goals, (batch_size,)))
    # Rows are drawn independently, so that which of them are relabelled needs no chance.
    relabelled = jnp.arange(batch_size, dtype=jnp.float32) < batch_size * hindsight.n_sampled_goal / (hindsight.n_sampled_goal + 1.0)
    relabelled &= first >= replay.written - replay.ring.size
    goals = jax.tree.map(lambda x: x[(chosen % steps) * num_envs + env], replay.ring.rows["next_obs"]["achieved_goal"])
    return with_goals(batch, goals, relabelled, replay.ring.rows["terminated"][index], gamma, goal)


def with_goals(
    batch: Transitions, goals: PyTree, relabelled: Bool[Array, " M"], terminated: Bool[Array, " M"], gamma: Number, goal: Goal
) -> Transitions:
    """The same transitions with these ``goals`` where ``relabelled``, and the rewards and ends that these bring."""

    def choose(new: Array, old: Array) -> Array:
        return jnp.where(relabelled.reshape(relabelled.shape + (1,) * (old.ndim - 1)), new, old)

    before, after = batch.obs["desired_goal"], batch.next_obs["achieved_goal"]
    desired = jax.tree.map(choose, goals, before)
    reward = jnp.where(relabelled, goal.reward(after, desired), batch.reward)
    for_another_reason = terminated & ~goal.terminated(after, before)
    ended = jnp.where(relabelled, goal.terminated(after, desired) | for_another_reason, terminated)
    return batch._replace(
        obs={**batch.obs, "desired_goal": desired},
        next_obs={**batch.next_obs, "desired_goal": desired},
        reward=reward,
        discount=jnp.where(ended, 0.0, gamma),
    )


def _chosen_step(
    strategy: str, first: Int[Array, " M"], number: Int[Array, " M"], last: Int[Array, " M"], chance: Float[Array, " M"]
) -> Int[Array, " M"]:
    """The step whose achievement becomes the goal."""
    if strategy == "final":
        return last
    earliest = number if strategy == "future" else first
    return jnp.minimum(earliest + (chance * (last - earliest + 1)).astype(jnp.int32), last)
