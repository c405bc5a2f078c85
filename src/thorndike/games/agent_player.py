"""A trained policy as a player: searches with its network from the position, or plays the network's best move where it cannot search."""

import hashlib
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from thorndike.errors import UserError
from thorndike.games.environment import observed_position
from thorndike.games.game import Choice, Game, Player, Position, Turn
from thorndike.games.players import choice_of
from thorndike.games.search import Evaluate, search, settings_from
from thorndike.networks.masking import FORBIDDEN
from thorndike.types import Algorithm, Wrapper

SIMULATIONS = 64
"""A move, where nobody says otherwise."""


def agent_player(
    name: str,
    game: Game,
    algorithm: Algorithm,
    wrapper: Wrapper,
    actor: PyTree,
    statistics: PyTree,
    config: Mapping[str, object],
    simulations: int = SIMULATIONS,
) -> Player:
    """``actor`` and ``statistics`` are of one seed; ``config`` is what it was trained with, of which the search's settings are taken.

    With 0 simulations, and in games that are not searched (dice, one player), the network's likeliest move is played. Raises UserError for
    an algorithm whose policy does not tell probabilities of moves.
    """
    if algorithm.probabilities is None:
        raise UserError(f"{name} tells no probabilities of moves, so it cannot play here: train it with alphazero, muzero or ppo")
    evaluate = _evaluation(game, algorithm, algorithm.probabilities, wrapper, statistics)
    settings = settings_from(config, max(simulations, 1))
    searches = simulations > 0 and game.can_be_searched

    def deep(position: Position) -> PyTree:
        return search(game, evaluate, settings, actor, position, jax.random.key(0), explore=False)

    def plain(position: Position) -> tuple[Array, Array]:
        logits, value = evaluate(actor, position, jax.random.key(0))
        return jnp.argmax(jnp.where(jax.vmap(game.legal)(position), logits, FORBIDDEN), axis=-1), value

    look = jax.jit(deep if searches else plain)

    def choose(turn: Turn) -> Choice:
        found = look(jax.tree.map(lambda leaf: leaf[None], turn.position))
        if searches:
            return choice_of(found)
        action, value = jax.device_get(found)
        return Choice(int(action[0]), min(max(float(value[0] + 1) / 2, 0.0), 1.0) if game.can_be_searched else None)

    return Player(name, choose, identity=fingerprint((actor, statistics)))


def fingerprint(tree: PyTree) -> str:
    """A short text that another tree has another of."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _evaluation(game: Game, algorithm: Algorithm, probabilities: Callable, wrapper: Wrapper, statistics: PyTree) -> Evaluate:
    """What the policy thinks of positions, in the form that a search asks for."""

    def evaluate(actor: PyTree, positions: Position, key: Key[Array, ""]) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        del key
        batch = jax.vmap(lambda position: observed_position(game, position))(positions)
        _, seen = wrapper.init(statistics, batch)
        size = jax.tree.leaves(positions)[0].shape[0]
        chances = probabilities(actor, algorithm.memory(size), seen)
        return jnp.log(jnp.maximum(chances, 1e-12)), jnp.clip(algorithm.value(actor, seen), -1.0, 1.0)

    return evaluate
