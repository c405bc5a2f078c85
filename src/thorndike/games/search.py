"""Monte-Carlo tree search of a two-player game, batched and compiled: mctx's trees with a game's rules.

``puct`` is AlphaZero's (Silver et al. 2018, Science 362): PUCT with Dirichlet noise at the root, where a move not yet tried counts as lost.
``gumbel`` is Gumbel AlphaZero's (Danihelka et al. 2022, "Policy improvement by planning with Gumbel"): the moves tried at the root are
drawn without replacement and halved, and the policy that comes out is better than the prior even after a few simulations.

A value is always that of the player to move, so it changes its sign from one node to the next (``discount`` -1; +1 where a player moves
twice). Below a finished position nothing counts (``discount`` 0), and nothing begins anew there.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mctx
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.games.game import Game, Position
from thorndike.games.tree_loop import Simulations
from thorndike.networks.board import win_value
from thorndike.networks.masking import FORBIDDEN
from thorndike.networks.network import Network

SEARCHES = ("gumbel", "puct")

Evaluate: TypeAlias = Callable[[PyTree, Position, Key[Array, ""]], tuple[Float[Array, "B actions"], Float[Array, " B"]]]
"""parameters, positions ``[B]``, key -> logits of the moves, value in [-1, 1] for the player to move."""

LONGEST_LINE = 8
"""Moves of a principal variation."""


class SearchSettings(NamedTuple):
    """How to search."""

    kind: str = "gumbel"
    simulations: int = 32
    dirichlet_alpha: float = 1.0
    """Of ``puct``: concentration of the noise at the root."""
    dirichlet_fraction: float = 0.25
    """Of ``puct``: its share of the prior there."""
    c_puct: float = 1.25
    """Of ``puct``: weight of the prior."""
    considered_moves: int = 16
    """Of ``gumbel``: moves tried at the root."""
    value_scale: float = 0.5
    """Of ``gumbel``: c_scale, the weight of values against the prior; 0.5 is the paper's 1 for values in [0, 1]."""
    rescale_values: bool = False
    """Stretch the values of a node's moves to [0, 1] first: where nobody knows how large values are."""


def settings_from(config: Mapping[str, object], simulations: int) -> SearchSettings:
    """Of a learner's settings those of its search, by the same names; ``search`` is the kind."""
    values = SearchSettings()._asdict()
    values |= {name: config[name] for name in values if name in config}
    return SearchSettings(**values | {"kind": config.get("search", values["kind"]), "simulations": simulations})


class Found(NamedTuple):
    """What a search of positions ``[B]`` found."""

    action: Int[Array, " B"]
    """The best move; when exploring, with the noise that it was searched with."""
    policy: Float[Array, "B actions"]
    """The improved policy: what a network is taught."""
    value: Float[Array, " B"]
    """Of the position, for the player to move, by all simulations."""
    visits: Int[Array, "B actions"]
    line: Int[Array, "B length"]
    """The moves tried most often one after another, ``action`` first; -1 beyond its end."""


def search(
    game: Game,
    evaluate: Evaluate,
    settings: SearchSettings,
    params: PyTree,
    positions: Position,
    key: Key[Array, ""],
    explore: bool,
) -> Found:
    """Search positions ``[B]`` that are not finished. Without ``explore`` there is no noise but for ties. Consumes the key.

    Raises ``UserError`` for games of one player, and games with dice.
    """
    if not game.can_be_searched:
        raise UserError(f"the search is for two players without dice, which {game.id} is not")
    key_root, key_search = jax.random.split(key)
    logits, value = evaluate(params, positions, key_root)
    legal = jax.vmap(game.legal)(positions)
    root = mctx.RootFnOutput(prior_logits=jnp.where(legal, logits, FORBIDDEN), value=value, embedding=positions)
    return grow(settings, params, root, _recurrent(game, evaluate), legal, key_search, explore)


def grow(
    settings: SearchSettings,
    params: PyTree,
    root: mctx.RootFnOutput,
    recurrent: mctx.RecurrentFn,
    legal: Bool[Array, "B actions"],
    key: Key[Array, ""],
    explore: bool,
) -> Found:
    """Search from ``root``, whatever it is that ``recurrent`` follows: rules, or what a network thinks of them. Consumes the key."""
    shared = (params, key, root, recurrent, settings.simulations, ~legal)
    if settings.kind == "puct":
        scaled = mctx.qtransform_by_parent_and_siblings if settings.rescale_values else _scaled_to_unit
        select = partial(mctx.muzero_action_selection, pb_c_init=settings.c_puct, qtransform=scaled)
        output = mctx.muzero_policy(
            *shared,
            loop_fn=Simulations(params, recurrent, select, select),
            qtransform=scaled,
            dirichlet_fraction=settings.dirichlet_fraction if explore else 0.0,
            dirichlet_alpha=settings.dirichlet_alpha,
            pb_c_init=settings.c_puct,
        )
        action = jnp.argmax(output.action_weights, axis=-1)
    else:
        considered, completed = min(settings.considered_moves, legal.shape[1]), _completed(settings)

        def at_root(key: Key[Array, ""], tree: mctx.Tree, node: Int[Array, ""], depth: Int[Array, ""] | int) -> Int[Array, ""]:
            del depth
            counts = {"num_simulations": settings.simulations, "max_num_considered_actions": considered}
            return mctx.gumbel_muzero_root_action_selection(key, tree, node, **counts, qtransform=completed)

        inside = partial(mctx.gumbel_muzero_interior_action_selection, qtransform=completed)
        output = mctx.gumbel_muzero_policy(
            *shared,
            loop_fn=Simulations(params, recurrent, at_root, inside),
            qtransform=completed,
            max_num_considered_actions=considered,
            gumbel_scale=1.0 if explore else 0.0,
        )
        action = output.action
    summary = output.search_tree.summary()
    action = action.astype(jnp.int32)
    line = jax.vmap(_line)(output.search_tree, action)
    return Found(action, output.action_weights, summary.value, summary.visit_counts.astype(jnp.int32), line)


def _line(tree: mctx.Tree, action: Int[Array, ""]) -> Int[Array, " length"]:
    """From the root of one tree: a move, and the replies that were tried most often."""

    def follow(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        node, move = carry
        child = jnp.where(move >= 0, tree.children_index[node, move], -1)
        visits = tree.children_visits[child]
        # Where a game is over the tree grows on, with a discount of 0.
        goes_on = (child >= 0) & (tree.children_discounts[node, move] != 0) & jnp.any(visits > 0)
        reply = jnp.where(goes_on, jnp.argmax(visits), -1).astype(jnp.int32)
        return (jnp.maximum(child, 0), reply), move

    return jax.lax.scan(follow, (jnp.int32(tree.ROOT_INDEX), action), None, length=LONGEST_LINE)[1]


def _recurrent(game: Game, evaluate: Evaluate) -> mctx.RecurrentFn:
    """One move in the tree of each position."""

    def step_one(position: Position, action: Int[Array, ""], key: Key[Array, ""]) -> tuple[Position, Array, Array, Bool[Array, ""], Array]:
        mover, over = game.player(position), game.terminated(position)
        stepped = game.step(position, action, key)
        after = jax.tree.map(lambda before, then: jnp.where(over, before, then), position, stepped)
        ended = over | game.terminated(after)
        reward = jnp.where(over, 0.0, game.rewards(after)[mover])
        sign = jnp.where(game.player(after) == mover, 1.0, -1.0)
        return after, reward, jnp.where(ended, 0.0, sign), ended, game.legal(after)

    def recurrent(
        params: PyTree, key: Key[Array, ""], actions: Int[Array, " B"], positions: Position
    ) -> tuple[mctx.RecurrentFnOutput, Position]:
        key_step, key_evaluate = jax.random.split(key)
        keys = jax.random.split(key_step, actions.shape[0])
        after, reward, discount, ended, legal = jax.vmap(step_one)(positions, actions, keys)
        logits, value = evaluate(params, after, key_evaluate)
        # Where no move is legal all stay equal: such a position is finished.
        output = mctx.RecurrentFnOutput(
            reward=reward,
            discount=discount,
            prior_logits=jnp.where(legal | ended[:, None], logits, FORBIDDEN),
            value=jnp.where(ended, 0.0, value),
        )
        return output, after

    return recurrent


def _scaled_to_unit(tree: mctx.Tree, node: Int[Array, ""]) -> Float[Array, " actions"]:
    return mctx.qtransform_by_min_max(tree, node, min_value=-1.0, max_value=1.0)


def _completed(settings: SearchSettings) -> Callable[[mctx.Tree, Int[Array, ""]], Float[Array, " actions"]]:
    def transform(tree: mctx.Tree, node: Int[Array, ""]) -> Float[Array, " actions"]:
        return mctx.qtransform_completed_by_mix_value(tree, node, value_scale=settings.value_scale, rescale_values=settings.rescale_values)

    return transform


def by_network(game: Game, network: Network) -> Evaluate:
    """The evaluation of a network of boards."""

    def evaluate(params: PyTree, positions: Position, key: Key[Array, ""]) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        del key
        logits, win, *_ = network.apply(params, jax.vmap(game.observe)(positions))
        return logits, win_value(win)

    return evaluate


def by_playouts(game: Game) -> Evaluate:
    """The evaluation of plain Monte-Carlo tree search: every move alike, the value by one game played out at random."""

    def play_out(position: Position, key: Key[Array, ""]) -> Float[Array, ""]:
        mover = game.player(position)

        def move(carry: tuple[Position, Key[Array, ""]]) -> tuple[Position, Key[Array, ""]]:
            position, key = carry
            key, key_choose, key_step = jax.random.split(key, 3)
            action = jax.random.categorical(key_choose, jnp.where(game.legal(position), 0.0, FORBIDDEN))
            return game.step(position, action, key_step), key

        last, _ = jax.lax.while_loop(lambda carry: ~game.terminated(carry[0]), move, (position, key))
        return game.rewards(last)[mover]

    def evaluate(params: PyTree, positions: Position, key: Key[Array, ""]) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        del params
        keys = jax.random.split(key, jax.tree.leaves(positions)[0].shape[0])
        value = jax.vmap(play_out)(positions, keys)
        return jnp.zeros((value.shape[0], game.num_actions)), value

    return evaluate
