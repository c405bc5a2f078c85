"""A trained policy as a player: searches with its network from the position, or plays the network's best move where it cannot search."""

import hashlib
import itertools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from thorndike.dependence import looked_at
from thorndike.errors import UserError
from thorndike.games.cut_search import cut_search
from thorndike.games.environment import observed_position
from thorndike.games.game import Choice, Game, Player, Position, Turn
from thorndike.games.players import choice_of
from thorndike.games.plies import positions_before
from thorndike.games.search import Evaluate, settings_from
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

    With 0 simulations, and in games that are not searched (dice, one player), the network's likeliest move is played. So it is by a policy
    with memory, which follows the whole game: its value of positions to come is not known. Raises UserError for an algorithm whose policy
    does not tell probabilities of moves.
    """
    if algorithm.probabilities is None:
        raise UserError(f"{name} tells no probabilities of moves, so it cannot play here: train it with alphazero, muzero or ppo")
    if _remembers(game, algorithm, algorithm.probabilities, wrapper, actor, statistics):
        chosen = _remembering(game, algorithm, algorithm.probabilities, wrapper, actor, statistics)
        return Player(name, lambda turn: Choice(chosen(turn)), identity=fingerprint((actor, statistics)))
    evaluate = _evaluation(game, algorithm, algorithm.probabilities, wrapper, statistics)
    settings = settings_from(config, max(simulations, 1))
    searches = simulations > 0 and game.can_be_searched

    deep = cut_search(game, evaluate, settings)

    @jax.jit
    def plain(position: Position) -> tuple[Array, Array]:
        batch = jax.tree.map(lambda leaf: leaf[None], position)
        logits, value = evaluate(actor, batch, jax.random.key(0))
        return jnp.argmax(jnp.where(jax.vmap(game.legal)(batch), logits, FORBIDDEN), axis=-1), value

    def choose(turn: Turn) -> Choice:
        if searches:
            return choice_of(deep(actor, turn.position, jax.random.key(0), turn.stopped))
        action, value = jax.device_get(plain(turn.position))
        return Choice(int(action[0]), min(max(float(value[0] + 1) / 2, 0.0), 1.0) if game.can_be_searched else None)

    return Player(name, choose, identity=fingerprint((actor, statistics)))


def _remembers(game: Game, algorithm: Algorithm, probabilities: Callable, wrapper: Wrapper, actor: PyTree, statistics: PyTree) -> bool:
    """Whether its moves depend on its memory; AlphaZero's counts the moves of a game, which is nothing to the network."""

    def asked(memory: PyTree) -> PyTree:
        position = jax.tree.map(lambda leaf: leaf[None], observed_position(game, game.init(jax.random.key(0))))
        return probabilities(actor, memory, wrapper.init(statistics, position)[1])

    return any(looked_at(asked, algorithm.memory(1)))


def _remembering(
    game: Game, algorithm: Algorithm, probabilities: Callable, wrapper: Wrapper, actor: PyTree, statistics: PyTree
) -> Callable[[Turn], int]:
    """The likeliest move of a policy that has seen the game from its beginning, as it did when it learnt: both sides' positions.

    What it remembers is kept for the next question, and made again where moves were taken back.
    """

    def seen(position: Position) -> PyTree:
        batch = jax.tree.map(lambda leaf: leaf[None], observed_position(game, position))
        return wrapper.init(statistics, batch)[1]

    # The decision itself is not looked at, and neither is its noise.
    noise = jax.tree.map(lambda leaf: leaf[0, :1], algorithm.draw(jax.random.key(0), 1))
    follow = jax.jit(lambda memory, position: algorithm.greedy(actor, memory, seen(position), noise)[0])
    look = jax.jit(lambda memory, position: probabilities(actor, memory, seen(position))[0])
    known: list[tuple[int, Position]] = []
    memories = [algorithm.memory(1)]

    def holds(before: tuple[int, Position], now: tuple[int, Position]) -> bool:
        # After the same moves only dice make another position.
        return before[0] == now[0] and (before[1] is now[1] or not game.has_chance)

    def choose(turn: Turn) -> int:
        played = list(zip(turn.moves, positions_before(turn), strict=True))
        same = len(list(itertools.takewhile(lambda pair: holds(*pair), zip(known, played, strict=False))))
        del known[same:], memories[same + 1 :]
        for action, position in played[same:]:
            memories.append(follow(memories[-1], position))
            known.append((action, position))
        legal = np.asarray(jax.jit(game.legal)(turn.position))
        return int(np.argmax(np.where(legal, np.asarray(look(memories[-1], turn.position)), -1.0)))

    return choose


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
