"""A studio with small players of the tests' own, in a process of its own: served_studio.py TOKEN [HOST [STORE]] prints the address.

With a preference store, its project ``clips`` is judged there, too.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.errors import UserError
from thorndike.games.game import Choice, Game, Player, Turn
from thorndike.language.preferences.assignment import Plan
from thorndike.language.preferences.store import Store
from thorndike.web.home import Door
from thorndike.web.label import Labelling
from thorndike.web.label_server import doors_to
from thorndike.web.opponents import Opponent
from thorndike.web.server import serve


def lookahead(game: Game, simulations: int) -> Player:
    """Wins where it can at once, else prefers the middle; what it tells is made up, but of the right form."""
    step, rewards = jax.jit(game.step), jax.jit(game.rewards)

    def choose(turn: Turn) -> Choice:
        legal = [int(action) for action in np.flatnonzero(np.asarray(game.legal(turn.position)))]
        mover, key = int(game.player(turn.position)), jax.random.key(0)
        after = {action: step(turn.position, jnp.int32(action), key) for action in legal}
        wins = [action for action in legal if float(rewards(after[action])[mover]) > 0]
        middle = (game.num_actions - 1) / 2
        best = wins[0] if wins else min(legal, key=lambda action: abs(action - middle))
        near = {action: 1 / (1 + abs(action - best)) ** 2 for action in legal}
        visits = {action: round(simulations * share / sum(near.values())) for action, share in near.items()}
        chance = 1.0 if wins else 0.5 + 0.04 * ((len(turn.moves) * 7) % 9 - 4)
        return Choice(best, chance, visits, (best,))

    return Player(f"Lookahead, {simulations}", choose)


def slow(game: Game, simulations: int) -> Player:
    """The first legal move, after as many hundredths of a second as it has simulations."""

    def choose(turn: Turn) -> Choice:
        time.sleep(simulations / 100)
        return Choice(int(np.flatnonzero(np.asarray(game.legal(turn.position)))[0]))

    return Player("Slow", choose)


def first(game: Game, simulations: int) -> Player:
    return Player("First", lambda turn: Choice(int(np.flatnonzero(np.asarray(game.legal(turn.position)))[0])))


def broken(game: Game, simulations: int) -> Player:
    def choose(turn: Turn) -> Choice:
        raise UserError("the engine has gone")

    return Player("Broken", choose)


def faulty(game: Game, simulations: int) -> Player:
    raise ValueError("a fault that nobody foresaw")


def leaving(game: Game, simulations: int) -> Player:
    """Not offered any more once it has sat down, as a checkpoint that made room for a newer one."""
    gone.append("leaving")
    return first(game, simulations)


gone: list[str] = []
OPPONENTS = (
    Opponent("lookahead", "Lookahead", lookahead, searches=True),
    Opponent("first", "First legal move", first),
    Opponent("slow", "Slow", slow, searches=True),
    Opponent("broken", "Broken", broken),
    Opponent("faulty", "Faulty", faulty),
    Opponent("leaving", "Leaving", leaving),
)


def doors(where: str) -> tuple[Door, ...]:
    store = Store(where)
    return doors_to(Labelling(store, store.project("clips"), "clips", Plan(), Path(where).parent))


if __name__ == "__main__":
    serve(
        ("tic_tac_toe", "connect_four"),
        lambda game_id: [each for each in OPPONENTS if each.id not in gone],
        host=sys.argv[2] if len(sys.argv) > 2 else "127.0.0.1",
        port=0,
        told=lambda address: print(address, flush=True),
        token=sys.argv[1],
        doors=doors(sys.argv[3]) if len(sys.argv) > 3 else (),
    )
