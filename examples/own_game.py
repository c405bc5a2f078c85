"""A game of your own in one file: Nim. Whoever takes the last bead wins.

thorndike train alphazero examples/own_game.py:NIM --steps 60k
"""

import jax.numpy as jnp
import numpy as np

from thorndike.games.game import Board, Game

ROWS, LONGEST = 3, 5
BEADS = jnp.array([3, 4, 5], jnp.int32)


def init(key):
    """A position is any tree of arrays: here the beads of each row, and whose turn it is."""
    return {"beads": BEADS, "player": jnp.zeros((), jnp.int32)}


def step(position, action, key):
    """Action ``row * 5 + n`` takes ``n + 1`` beads from a row."""
    row, taken = action // LONGEST, action % LONGEST + 1
    beads = position["beads"] - jnp.where(jnp.arange(ROWS) == row, taken, 0)
    return {"beads": beads.astype(jnp.int32), "player": 1 - position["player"]}


def legal(position):
    return (position["beads"][:, None] > jnp.arange(LONGEST)[None]).reshape(-1)


def terminated(position):
    return jnp.sum(position["beads"]) == 0


def rewards(position):
    """Whoever is to move when all beads are gone has lost."""
    result = jnp.where(jnp.arange(2) == position["player"], -1.0, 1.0)
    return jnp.where(terminated(position), result, 0.0)


def observe(position):
    """Height, width, channels: a bead is 1. It is the same for both players, and the mover knows that it is his turn."""
    return (position["beads"][:, None] > jnp.arange(LONGEST)[None]).astype(jnp.float32)[..., None]


def board(position):
    """For people. A click takes the bead and all to its right."""
    beads = np.asarray(position["beads"])
    rows = tuple(tuple("O" if column < count else "" for column in range(LONGEST)) for count in beads)
    clicks = {((row, column),): row * LONGEST + count - column - 1 for row, count in enumerate(beads) for column in range(count)}
    return Board(rows, tuple("abc"), tuple("12345"), clicks, {})


def action_name(position, action):
    """The row and how many: ``b2``."""
    return f"{'abc'[action // LONGEST]}{action % LONGEST + 1}"


NIM = Game(
    id="nim",
    num_actions=ROWS * LONGEST,
    observation_shape=(ROWS, LONGEST, 1),
    max_moves=12,
    init=init,
    step=step,
    legal=legal,
    player=lambda position: position["player"],
    terminated=terminated,
    rewards=rewards,
    observe=observe,
    board=board,
    action_name=action_name,
)

if __name__ == "__main__":
    import thorndike as td

    settings = {"n_steps": 4, "learning_starts": 2_000, "num_simulations": 16, "width": 64, "blocks": 1}
    result = td.train("alphazero", NIM, steps=60_000, num_envs=64, settings=settings)
    print(td.load(result.run, environment=NIM).evaluate(episodes=100))
