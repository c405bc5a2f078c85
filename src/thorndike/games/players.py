"""Players of our own: random moves, and plain Monte-Carlo tree search, which knows nothing but the rules."""

import jax
import numpy as np

from thorndike.games.cut_search import cut_search
from thorndike.games.game import Choice, Game, Player, Turn
from thorndike.games.search import Found, SearchSettings, by_playouts

PLAYOUTS = 100
"""Of ``mcts`` a move, where nobody says otherwise."""


def random_player(seed: int = 0) -> Player:
    """Every legal move alike."""
    random = np.random.default_rng(seed)

    def choose(turn: Turn) -> Choice:
        return Choice(int(random.choice(np.flatnonzero(jax.jit(turn.game.legal)(turn.position)))))

    return Player("random", choose)


def mcts_player(game: Game, simulations: int = PLAYOUTS, seed: int = 0) -> Player:
    """Tree search by PUCT with equal priors, each leaf valued by one game played out at random. Compiled at the first move.

    Raises UserError for games of one player, and games with dice, when it is asked.
    """
    look = cut_search(game, by_playouts(game), SearchSettings("puct", simulations))
    base, asked = jax.random.key(seed), 0

    def choose(turn: Turn) -> Choice:
        nonlocal asked
        asked += 1
        return choice_of(look((), turn.position, jax.random.fold_in(base, asked), turn.stopped))

    return Player(f"mcts:simulations={simulations}", choose)


def choice_of(found: Found) -> Choice:
    """What a search of one position found, as an answer."""
    found = jax.device_get(found)
    visits = {int(action): int(found.visits[0, action]) for action in np.flatnonzero(found.visits[0])}
    line = tuple(int(action) for action in found.line[0] if action >= 0)
    return Choice(int(found.action[0]), min(max(float(found.value[0] + 1) / 2, 0.0), 1.0), visits, line)
