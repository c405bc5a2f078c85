"""The simulations of mctx's search for all trees of a batch at once: the same trees bit for bit, in less time.

mctx maps a program for one tree over the batch, and a loop of a mapped program chooses between old and new for everything that it
carries: each step back to the root copies the statistics of all moves of all nodes. Here each step writes one number a tree. Both of
mctx's policies take a loop to run their simulations in (``loop_fn``); this one is put there, and the step that mctx hands over is not used.

The root's move is chosen outside the loop that walks down, so that the choice at the root is not made once more at every level.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mctx
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

Select: TypeAlias = Callable[[Key[Array, ""], mctx.Tree, Int[Array, ""], Int[Array, ""] | int], Int[Array, ""]]
"""key, tree, node, depth -> the move tried there, of one tree."""


class Simulations(NamedTuple):
    """What a simulation needs beside the trees."""

    params: PyTree
    recurrent: mctx.RecurrentFn
    at_root: Select
    inside: Select

    def __call__(self, first: int, end: int, unused: Callable, carried: tuple[Array, mctx.Tree]) -> tuple[Array, mctx.Tree]:
        """In place of ``jax.lax.fori_loop``."""
        return jax.lax.fori_loop(first, end, self.simulate, carried)

    def simulate(self, number: Int[Array, ""], carried: tuple[Array, mctx.Tree]) -> tuple[Array, mctx.Tree]:
        """Down each tree to a move not tried yet, a new node there, and its value back to the root."""
        key, tree = carried
        key, key_walk, key_expand = jax.random.split(key, 3)
        each = jnp.arange(tree.node_values.shape[0])
        parent, action = self._walk(jax.random.split(key_walk, each.size), tree)
        existing = tree.children_index[each, parent, action]
        node = jnp.where(existing == mctx.Tree.UNVISITED, number + 1, existing)
        return key, _told(self._expanded(key_expand, tree, parent, action, node), node)

    def _walk(self, keys: Key[Array, " B"], tree: mctx.Tree) -> tuple[Int[Array, " B"], Int[Array, " B"]]:
        """The last node of each tree's walk, and the untried move there."""
        each, longest = jnp.arange(tree.node_values.shape[0]), tree.num_simulations
        root = jnp.full(each.shape, mctx.Tree.ROOT_INDEX, jnp.int32)

        def choose(select: Select, keys: Key[Array, " B"], node: Int[Array, " B"], depth: Int[Array, ""] | int) -> tuple[Array, Array]:
            following, now = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
            return following, jax.vmap(select, in_axes=(0, 0, 0, None))(now, tree, node, depth)

        def goes_on(node: Int[Array, " B"], action: Int[Array, " B"], depth: Int[Array, ""] | int) -> tuple[Array, Bool[Array, " B"]]:
            child = tree.children_index[each, node, action]
            return child, (child != mctx.Tree.UNVISITED) & (depth < longest)

        def down(state: tuple[Array, Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array, Array]:
            keys, node, action, child, going, depth = state
            keys, chosen = choose(self.inside, keys, child, depth)
            node, action = jnp.where(going, child, node), jnp.where(going, chosen, action)
            child, further = goes_on(node, action, depth + 1)
            return keys, node, action, child, going & further, depth + 1

        keys, action = choose(self.at_root, keys, root, 0)
        child, going = goes_on(root, action, 1)
        state = (keys, root, action, child, going, jnp.int32(1))
        _, node, action, *_ = jax.lax.while_loop(lambda state: jnp.any(state[4]), down, state)
        return node, action

    def _expanded(
        self, key: Key[Array, ""], tree: mctx.Tree, parent: Int[Array, " B"], action: Int[Array, " B"], node: Int[Array, " B"]
    ) -> mctx.Tree:
        """With what the network says of each new node."""
        each = jnp.arange(parent.size)
        before = jax.tree.map(lambda x: x[each, parent], tree.embeddings)
        step, after = self.recurrent(self.params, key, action, before)
        return tree.replace(
            children_prior_logits=tree.children_prior_logits.at[each, node].set(step.prior_logits),
            raw_values=tree.raw_values.at[each, node].set(step.value),
            node_values=tree.node_values.at[each, node].set(step.value),
            node_visits=tree.node_visits.at[each, node].add(1),
            embeddings=jax.tree.map(lambda stored, new: stored.at[each, node].set(new), tree.embeddings, after),
            children_index=tree.children_index.at[each, parent, action].set(node),
            children_rewards=tree.children_rewards.at[each, parent, action].set(step.reward),
            children_discounts=tree.children_discounts.at[each, parent, action].set(step.discount),
            parents=tree.parents.at[each, node].set(parent),
            action_from_parent=tree.action_from_parent.at[each, node].set(action),
        )


class _Statistics(NamedTuple):
    """What a value changes on its way to the root."""

    node_values: Float[Array, "B nodes"]
    node_visits: Int[Array, "B nodes"]
    children_values: Float[Array, "B nodes actions"]
    children_visits: Int[Array, "B nodes actions"]


def _told(tree: mctx.Tree, leaf: Int[Array, " B"]) -> mctx.Tree:
    """The leaves' values told to all nodes above them."""
    each, beyond = jnp.arange(leaf.size), tree.node_values.shape[1]

    def up(state: tuple[_Statistics, Array, Array]) -> tuple[_Statistics, Array, Array]:
        told, value, node = state
        parent, action = tree.parents[each, node], tree.action_from_parent[each, node]
        count = told.node_visits[each, parent]
        value = tree.children_rewards[each, parent, action] + tree.children_discounts[each, parent, action] * value
        mean = (told.node_values[each, parent] * count + value) / (count + 1.0)
        # A tree whose root has been reached writes beyond its end, which is dropped.
        at = jnp.where(node == mctx.Tree.ROOT_INDEX, beyond, parent)
        written = _Statistics(
            told.node_values.at[each, at].set(mean, mode="drop"),
            told.node_visits.at[each, at].set(count + 1, mode="drop"),
            told.children_values.at[each, at, action].set(told.node_values[each, node], mode="drop"),
            told.children_visits.at[each, at, action].add(1, mode="drop"),
        )
        return written, value, jnp.where(node == mctx.Tree.ROOT_INDEX, node, parent)

    told = _Statistics(tree.node_values, tree.node_visits, tree.children_values, tree.children_visits)
    begin = (told, tree.node_values[each, leaf], leaf)
    told, _, _ = jax.lax.while_loop(lambda state: jnp.any(state[2] != mctx.Tree.ROOT_INDEX), up, begin)
    return tree.replace(**told._asdict())
