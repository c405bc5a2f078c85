"""A search of one position that can be cut: the simulations in parts, between which somebody is asked whether the answer is still wanted.

What it finds is what ``search`` finds. Its three programs, the root, some simulations and the answer, share the tree.
"""

import time
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import mctx
from jaxtyping import Array, Bool, Int, Key, PyTree

from thorndike.games.game import Game, Position, Stopped
from thorndike.games.search import Evaluate, Found, SearchSettings, following, grow, rooted
from thorndike.games.tree_loop import Simulations

_FIRST = 32
"""Simulations of the first part; each further one has as many as take about ``_PART_S``."""
_PART_S = 0.05

Look: TypeAlias = Callable[[PyTree, Position, Key[Array, ""], Callable[[], bool]], Found]
"""parameters, position, key, whether to stop -> what was found, ``[1]``. Raises ``Stopped``."""
_Trees: TypeAlias = tuple[Key[Array, ""], mctx.Tree]
_Root: TypeAlias = tuple[mctx.RootFnOutput, Bool[Array, "B actions"], Key[Array, ""]]


def cut_search(game: Game, evaluate: Evaluate, settings: SearchSettings) -> Look:
    """Compiled when it is first asked. Raises UserError then for games that are not searched."""
    recurrent = following(game, evaluate)

    def grown(params: PyTree, root: _Root, run: Callable[[Simulations], mctx.LoopFn]) -> Found:
        return grow(settings, params, root[0], recurrent, root[1], root[2], False, run)

    def left_off(params: PyTree, root: _Root, loop: Callable[[Simulations, _Trees], _Trees]) -> _Trees:
        """The trees as ``loop`` leaves them; the answer that would be read from them is not computed."""
        found: list[_Trees] = []

        def run(simulations: Simulations) -> mctx.LoopFn:
            def once(first: int, end: int, step: Callable, trees: _Trees) -> _Trees:
                del first, end, step
                found.append(loop(simulations, trees))
                return trees

            return once

        grown(params, root, run)
        return found[0]

    @jax.jit
    def begin(params: PyTree, position: Position, key: Key[Array, ""]) -> tuple[_Root, _Trees]:
        key_root, key_search = jax.random.split(key)
        root = (*rooted(game, evaluate, params, jax.tree.map(lambda leaf: leaf[None], position), key_root), key_search)
        return root, left_off(params, root, lambda simulations, trees: trees)

    def go_on(params: PyTree, root: _Root, trees: _Trees, first: Int[Array, ""], end: Int[Array, ""]) -> _Trees:
        return left_off(params, root, lambda simulations, _: jax.lax.fori_loop(first, end, simulations.simulate, trees))

    @jax.jit
    def answer(params: PyTree, root: _Root, trees: _Trees) -> Found:
        return grown(params, root, lambda simulations: lambda first, end, step, begun: trees)

    go_on = jax.jit(go_on, donate_argnums=2)

    def look(params: PyTree, position: Position, key: Key[Array, ""], stopped: Callable[[], bool]) -> Found:
        root, trees = begin(params, position, key)
        done, size = 0, _FIRST
        while done < settings.simulations:
            if stopped():
                raise Stopped
            began, end = time.monotonic(), min(done + size, settings.simulations)
            trees = jax.block_until_ready(go_on(params, root, trees, jnp.int32(done), jnp.int32(end)))
            done, took = end, time.monotonic() - began
            size = max(1, size // 2) if took > 2 * _PART_S else 2 * size if took < _PART_S / 2 else size
        return answer(params, root, trees)

    return look
