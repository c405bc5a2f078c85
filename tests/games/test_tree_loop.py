"""Simulations of a whole batch at once: the trees are those that mctx itself makes, bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from games.test_search import evaluate_made_up
from thorndike.games import search as searching
from thorndike.games.search import SEARCHES, SearchSettings, search
from thorndike.games.tic_tac_toe import TIC_TAC_TOE, TicTacToePosition
from thorndike.games.tree_loop import Simulations

pytestmark = pytest.mark.usefixtures("quick_compile")

POSITIONS = TicTacToePosition(jnp.array([[0, 0], [1, 16], [17, 258], [0b1100, 0b10001], [0b101, 0b1010], [0b11, 0b110000]], jnp.uint32))
"""Of different depths, so that walks of one batch end at different levels; in some of them a move wins at once."""


class AsMctxDoes(Simulations):
    """The step that mctx hands over, in the usual loop."""

    def __call__(self, first, end, step, carried):
        return jax.lax.fori_loop(first, end, step, carried)


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_search_finds_what_mctx_finds(kind, monkeypatch):
    def found():
        settings = SearchSettings(kind, 60)
        look = jax.jit(lambda positions, key: search(TIC_TAC_TOE, evaluate_made_up, settings, (), positions, key, explore=True))
        return jax.device_get(look(POSITIONS, jax.random.key(5)))

    ours = found()
    monkeypatch.setattr(searching, "Simulations", AsMctxDoes)
    for name, own, theirs in zip(ours._fields, ours, found(), strict=True):
        np.testing.assert_array_equal(own, theirs, err_msg=name)
    assert (ours.line >= 0).sum(axis=1).max() >= 4
