"""Prioritised replay: transitions drawn in proportion to a power of their last error, by a sum tree that lives in the learner's state.

Schaul et al. 2016, "Prioritized Experience Replay" (arXiv:1511.05952), the proportional variant with stratified draws. Deviations:

1. The tree has 8 branches a node, not 2: a third of the levels, each one small kernel for the whole minibatch.
2. Importance weights are divided by the largest of their minibatch, as is usual, not by the largest of the whole memory.
3. Sums are recomputed from below where a priority changes, never added to, so that rounding does not pile up.

The cost of a draw and of a change grows with the logarithm of the ring's size.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.replay.uniform import ReplayBuffer, add, init_replay, transitions_at
from thorndike.types import Number, Rollout

BRANCHES = 8
SMALLEST = 1e-6
"""Added to every error, so that no transition is out of reach for good."""


Tree: TypeAlias = tuple[Float[Array, " _"], ...]
"""A sum tree: the leaves, then the sums of 8 neighbours each, up to a level of 8."""


class PrioritizedReplay(NamedTuple):
    """The ring, and a sum tree over its rows."""

    ring: ReplayBuffer
    levels: Tree
    """Its leaves are ``priority^alpha`` of every row. 0: the row cannot be drawn."""
    highest: Float[Array, ""]
    """The largest ``priority^alpha`` so far, which new rows begin with."""


class Draw(NamedTuple):
    """A minibatch and what is known of how it was drawn."""

    batch: PyTree
    """``Transitions`` ``[M, ...]``, or a ``Rollout`` ``[T, M / T, ...]`` of sequences."""
    rows: Int[Array, " R"]
    """Where they are stored; none where nobody needs to know."""
    importance: Float[Array, " M"]
    """Importance weights, the largest 1."""


def init_prioritized(row: PyTree, steps: int, num_envs: int) -> PrioritizedReplay:
    """An empty memory for ``steps`` steps of ``num_envs`` environments, of transitions shaped as ``row`` (see ``row_shapes``)."""
    return PrioritizedReplay(init_replay(row, steps, num_envs), empty_tree(steps * num_envs), jnp.ones((), jnp.float32))


def add_prioritized(replay: PrioritizedReplay, rollout: Rollout, n_step: int) -> PrioritizedReplay:
    """Write ``T`` steps over the oldest ones; what can be drawn for the first time gets the highest priority so far.

    The newest ``n_step - 1`` steps wait at 0 until what follows them is stored. A row that is no transition stays at 0.
    """
    length, num_envs = rollout.step.reward.shape
    ring = add(replay.ring, rollout)
    steps = jax.tree.leaves(ring.rows)[0].shape[0] // num_envs

    def rows_of(ages: Int[Array, " k"]) -> Int[Array, " r"]:
        step = (ring.position - 1 - ages) % steps
        return (step[:, None] * num_envs + jnp.arange(num_envs, dtype=jnp.int32)[None, :]).ravel()

    levels = replay.levels
    waiting = min(n_step - 1, steps)
    if waiting:
        rows = rows_of(jnp.arange(waiting, dtype=jnp.int32))
        levels = set_priorities(levels, rows, jnp.zeros(rows.shape))
    ages = n_step - 1 + jnp.arange(length, dtype=jnp.int32)
    rows, stored = rows_of(ages), jnp.repeat(ages < ring.size, num_envs)
    first = jnp.where(ring.rows["valid"][rows], replay.highest, 0.0)
    # Older than the ring is long, an age names a row of the newest steps, which waits.
    levels = set_priorities(levels, rows, jnp.where(stored, first, levels[0][rows]))
    return PrioritizedReplay(ring, levels, replay.highest)


def sample_prioritized(
    replay: PrioritizedReplay, key: Key[Array, ""], batch_size: int, num_envs: int, n_step: int, gamma: Number, beta: Number
) -> Draw:
    """Draw ``batch_size`` transitions, one from each equal share of the total priority. Consumes the key.

    ``beta`` is how far importance weights undo the priorities: Schaul et al. 2016, section 3.4.
    """
    strata = jnp.arange(batch_size, dtype=jnp.float32) + jax.random.uniform(key, (batch_size,))
    rows = find(replay.levels, strata / batch_size * jnp.sum(replay.levels[-1]))
    priority = replay.levels[0][rows]
    drawable = priority > 0.0
    lightest = jnp.min(jnp.where(drawable, priority, jnp.inf))
    importance = jnp.where(drawable, (lightest / jnp.where(drawable, priority, 1.0)) ** beta, 0.0)
    return Draw(transitions_at(replay.ring, rows, num_envs, n_step, gamma), rows, importance)


def update_priorities(replay: PrioritizedReplay, rows: Int[Array, " M"], error: Float[Array, " M"], alpha: Number) -> PrioritizedReplay:
    """Give drawn rows the priority of their new errors; of a row drawn twice, the larger one's."""
    raised = (jnp.abs(error) + SMALLEST) ** alpha
    raised = jnp.where(jnp.isfinite(raised) & (replay.levels[0][rows] > 0.0), raised, replay.levels[0][rows])
    cleared = replay.levels[0].at[rows].set(0.0, mode="promise_in_bounds")
    # The largest, not the last: an order of writing is not promised on every device.
    leaves = cleared.at[rows].max(raised, mode="promise_in_bounds")
    levels = _add_up((leaves, *replay.levels[1:]), rows)
    return replay._replace(levels=levels, highest=jnp.maximum(replay.highest, jnp.max(raised)))


def empty_tree(rows: int) -> Tree:
    """The levels of a sum tree over ``rows`` leaves, from the leaves up."""
    sizes = [_padded(rows)]
    while sizes[-1] > BRANCHES:
        sizes.append(_padded(sizes[-1] // BRANCHES))
    return tuple(jnp.zeros((size,), jnp.float32) for size in sizes)


def set_priorities(levels: Tree, rows: Int[Array, " R"], priority: Float[Array, " R"]) -> Tree:
    """The tree with these leaves changed. No row may come twice."""
    return _add_up((levels[0].at[rows].set(priority, mode="promise_in_bounds"), *levels[1:]), rows)


def find(levels: Tree, place: Float[Array, " M"]) -> Int[Array, " M"]:
    """The leaf at ``place`` on a line on which every leaf is as long as its priority; never one of length 0, if there is another."""
    node = jnp.zeros(place.shape, jnp.int32)
    for level in reversed(levels):
        children = level.reshape((-1, BRANCHES))[node]
        child, before = _child_at(children, place)
        place, node = place - before, node * BRANCHES + child
    return node


def _child_at(children: Float[Array, "M b"], place: Float[Array, " M"]) -> tuple[Int[Array, " M"], Float[Array, " M"]]:
    """Which child a place falls into, and how much lies before it."""
    shape = children.shape
    number = lax.broadcasted_iota(jnp.int32, shape, 1)
    ends = jnp.sum(jnp.where(_up_to(shape), children[:, None, :], 0.0), axis=-1)
    some = children > 0.0
    first = jnp.min(jnp.where(some & (ends > place[:, None]), number, BRANCHES), axis=-1)
    # Rounding may carry a place beyond the end of the last child that has any length.
    last = jnp.max(jnp.where(some, number, 0), axis=-1)
    child = jnp.minimum(first, last)
    return child, jnp.sum(jnp.where(number < child[:, None], children, 0.0), axis=-1)


def _up_to(shape: tuple[int, ...]) -> Bool[Array, "M b b"]:
    square = (*shape, BRANCHES)
    return lax.broadcasted_iota(jnp.int32, square, 2) <= lax.broadcasted_iota(jnp.int32, square, 1)


def _add_up(levels: Tree, rows: Int[Array, " R"]) -> Tree:
    """Every level with the sums above these leaves computed afresh."""
    done = [levels[0]]
    for level in levels[1:]:
        rows = rows // BRANCHES
        sums = jnp.sum(done[-1].reshape((-1, BRANCHES))[rows], axis=-1)
        done.append(level.at[rows].set(sums, mode="promise_in_bounds"))
    return tuple(done)


def _padded(size: int) -> int:
    return -(-size // BRANCHES) * BRANCHES
