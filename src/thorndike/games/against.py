"""A game against an opponent, in Gymnasium's form: what an agent that learnt from itself is evaluated on.

Games come in pairs: the same opening of a few random moves, colours swapped. The reward is the result: 1 for a win, 0 for a draw, -1 for a
loss or a move that is not legal; the mean over games is the mean score.
"""

from collections.abc import Callable

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key, UInt32

from thorndike.games.environment import observation_space, observed_position, opening
from thorndike.games.game import Game, Position
from thorndike.games.search import SearchSettings, by_playouts, search
from thorndike.games.settings import GameSettings
from thorndike.networks.masking import FORBIDDEN
from thorndike.types import Observation


class AgainstOpponent(gymnasium.Env):
    """One game after another; ``step`` is a move of the agent and the opponent's reply."""

    def __init__(self, game: Game, settings: GameSettings) -> None:
        """Compiles the opponent of ``settings``."""
        self.observation_space, self.action_space = observation_space(game), gymnasium.spaces.Discrete(game.num_actions)
        self.native_limit = game.max_moves
        """No game is longer: it has no Gymnasium spec that would say so."""
        self._game, self._begun, self._opening, self._agent = game, 0, np.uint32(0), 0
        choose = opponent(game, settings)

        def reply(position: Position, agent: Int[Array, ""], key: Key[Array, ""]) -> tuple[Position, Observation, Array, Array]:
            """The opponent's moves until it is the agent's turn, or the game is over."""

            def goes(carry: tuple[Position, Key[Array, ""]]) -> Array:
                return ~game.terminated(carry[0]) & (game.player(carry[0]) != agent)

            def move(carry: tuple[Position, Key[Array, ""]]) -> tuple[Position, Key[Array, ""]]:
                key, key_choose, key_step = jax.random.split(carry[1], 3)
                return game.step(carry[0], choose(carry[0], key_choose), key_step), key

            position, _ = jax.lax.while_loop(goes, move, (position, key))
            return position, observed_position(game, position), game.rewards(position)[agent], game.terminated(position)

        def begin(seed: UInt32[Array, ""]) -> Position:
            return opening(game, jax.random.key(seed), 1.0, min(settings.eval_opening_plies, game.max_moves - 1))

        def step(position: Position, action: Int[Array, ""], agent: Int[Array, ""], seed: UInt32[Array, ""]) -> tuple:
            key_step, key_reply = jax.random.split(jax.random.key(seed))
            return game.legal(position)[action], reply(game.step(position, action, key_step), agent, key_reply)

        self._begin, self._step = jax.jit(begin), jax.jit(step)
        self._reply = jax.jit(lambda position, agent, seed: reply(position, agent, jax.random.key(seed)))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Observation, dict]:
        """The next game; a seed begins a new pair."""
        super().reset(seed=seed)
        if seed is not None:
            self._begun = 0
        if self._begun % 2 == 0:
            self._opening, self._agent = self._seed(), int(self.np_random.integers(self._game.num_players))
        else:
            self._agent = self._game.num_players - 1 - self._agent
        self._begun += 1
        self._position, obs, _, _ = self._reply(self._begin(self._opening), np.int32(self._agent), self._seed())
        return jax.tree.map(np.asarray, obs), {}

    def step(self, action: object) -> tuple[Observation, float, bool, bool, dict]:
        """A move and its answer."""
        legal, outcome = self._step(self._position, np.asarray(action, np.int32), np.int32(self._agent), self._seed())
        if not legal:
            return jax.tree.map(np.asarray, observed_position(self._game, self._position)), -1.0, True, False, {}
        self._position, obs, reward, terminated = outcome
        return jax.tree.map(np.asarray, obs), float(reward), bool(terminated), False, {}

    def _seed(self) -> np.uint32:
        return np.uint32(self.np_random.integers(2**31))


def opponent(game: Game, settings: GameSettings) -> Callable[[Position, Key[Array, ""]], Int[Array, ""]]:
    """position, key -> a move of the opponent that ``settings`` name."""

    def at_random(position: Position, key: Key[Array, ""]) -> Int[Array, ""]:
        return jax.random.categorical(key, jnp.where(game.legal(position), 0.0, FORBIDDEN)).astype(jnp.int32)

    if settings.opponent == "random":
        return at_random
    how = SearchSettings("puct", settings.opponent_simulations)

    def by_search(position: Position, key: Key[Array, ""]) -> Int[Array, ""]:
        return search(game, by_playouts(game), how, (), jax.tree.map(lambda x: x[None], position), key, explore=False).action[0]

    return by_search
