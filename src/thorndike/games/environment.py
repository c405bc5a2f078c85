"""A game that plays itself, as a compiled batch of environments: whoever is to move acts, and is rewarded by what the move earned.

A share of the games begins with a few random moves, for a learner that only meets its own games knows nothing of others
(``opening_share``, ``opening_plies``; see ``settings.py``). An action beyond the game's own means that the mover resigns.
"""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Float, Int, Key

from thorndike.errors import UserError
from thorndike.games.game import Game, Position
from thorndike.games.packing import packing
from thorndike.games.settings import GameSettings, check_opponent
from thorndike.networks.masking import BOARD, FORBIDDEN, MASK, POSITION
from thorndike.types import Action, Environment, EnvSpec, Noise, Observation, Shared, Step

SELF_PLAY = GameSettings()
_POOL = 8
"""Games of a batch that share one opening, where they begin at the same step."""


def observation_space(game: Game) -> gymnasium.spaces.Dict:
    """What a player sees, which moves are legal, and the whole position, from which to search."""
    whole = np.iinfo(np.int32)
    return spaces.Dict(
        {
            BOARD: spaces.Box(-np.inf, np.inf, game.observation_shape, np.float32),
            MASK: spaces.MultiBinary(game.num_actions),
            POSITION: spaces.Box(whole.min, whole.max, (packing(game).size,), np.int32),
        }
    )


def observes_game(space: gymnasium.Space) -> bool:
    """Whether observations of this space are positions of a game."""
    return isinstance(space, spaces.Dict) and set(space.spaces) == {BOARD, MASK, POSITION}


def check_observations(spec: EnvSpec, game: Game) -> None:
    """Raises ``UserError`` if a wrapper hides what a game is learnt from, or gives it another shape."""
    given = getattr(spec.observation_space, "spaces", {})
    if any(name not in given or given[name].shape != space.shape for name, space in observation_space(game).spaces.items()):
        raise UserError(f"{spec.id} is learnt from its positions, which a wrapper hides or changes: leave the wrapper out")


def check_unchanged(spec: EnvSpec, game: Game) -> None:
    """Raises ``UserError`` also if a wrapper changes the numbers of a board.

    A learner that searches or turns boards as the rules show them would be asked about the changed ones for a value alone.
    """
    check_observations(spec, game)
    if getattr(spec.observation_space, "spaces", {})[BOARD] != observation_space(game)[BOARD]:
        raise UserError(f"{spec.id} is learnt from its board as the rules show it, which a wrapper changes (normalizes): leave it out")


def observed_position(game: Game, position: Position) -> Observation:
    """One position as an observation."""
    return {
        BOARD: game.observe(position),
        MASK: game.legal(position).astype(jnp.int8),
        POSITION: packing(game).pack(position),
    }


def game_environment(game: Game, num_envs: int, settings: GameSettings = SELF_PLAY) -> Environment:
    """``num_envs`` games side by side, each begun anew when it ends, as ``settings`` say. Raises ``UserError`` if there are none.

    Raises it also for an opponent that cannot play this game, before anything is learnt for it to be evaluated against.
    """
    # Dice make games differ by themselves.
    usual = 0 if game.has_chance else game.max_moves // 4
    share, plies = settings.opening_share, usual if settings.opening_plies is None else settings.opening_plies
    if num_envs < 1:
        raise UserError(f"num_envs of {game.id} must be at least 1, not {num_envs}: give a larger number")
    check_opponent(game.id, settings.opponent, game.can_be_searched)
    pool = -(-num_envs // _POOL)

    observe = jax.vmap(lambda position: observed_position(game, position))

    def begin(key: Key[Array, ""]) -> Position:
        keys = jax.random.split(key, pool)
        openings = jax.vmap(lambda key: opening(game, key, share, plies))(keys)
        return jax.tree.map(lambda x: jnp.tile(x, (_POOL,) + (1,) * (x.ndim - 1))[:num_envs], openings)

    def init(key: Key[Array, ""]) -> tuple[Position, Observation]:
        keys = jax.random.split(key, num_envs)
        positions = jax.vmap(lambda key: opening(game, key, share, plies))(keys)
        return positions, observe(positions)

    def draw(key: Key[Array, ""], steps: int) -> Noise:
        return Shared(jax.random.split(key, steps))

    def step_one(position: Position, action: Int[Array, ""], key: Key[Array, ""]) -> tuple[Position, Float[Array, ""], Array]:
        mover, resigns = game.player(position), action >= game.num_actions
        after = game.step(position, jnp.minimum(action, game.num_actions - 1), key)
        reward = jnp.where(resigns, -1.0, game.rewards(after)[mover])
        return after, reward, game.terminated(after) | resigns

    def step(positions: Position, action: Action, noise: Noise) -> tuple[Position, Step]:
        key_step, key_begin = jax.random.split(noise.numbers)
        after, reward, terminated = jax.vmap(step_one)(positions, action, jax.random.split(key_step, num_envs))
        fresh = begin(key_begin)

        def choose(new: Array, old: Array) -> Array:
            return jnp.where(terminated.reshape((num_envs,) + (1,) * (new.ndim - 1)), new, old)

        following = jax.tree.map(choose, fresh, after)
        next_obs, obs = observe(after), observe(following)
        no = jnp.zeros_like(terminated)
        return following, Step(obs, next_obs, reward, jnp.zeros_like(reward), terminated, no, ~no)

    spec = EnvSpec(game.id, observation_space(game), spaces.Discrete(game.num_actions), num_envs, game.max_moves, game=game)
    return Environment(init, step, draw, spec)


def opening(game: Game, key: Key[Array, ""], share: float, plies: int) -> Position:
    """A beginning: with probability ``share`` after 0 to ``plies`` random moves, none of which ends the game."""
    key_init, key_share, key_count, key_moves = jax.random.split(key, 4)
    position = game.init(key_init)
    if share == 0 or plies == 0:
        return position
    count = jnp.where(jax.random.uniform(key_share) < share, jax.random.randint(key_count, (), 0, plies + 1), 0)

    def move(i: Int[Array, ""], position: Position) -> Position:
        key_choose, key_step = jax.random.split(jax.random.fold_in(key_moves, i))
        action = jax.random.categorical(key_choose, jnp.where(game.legal(position), 0.0, FORBIDDEN))
        after = game.step(position, action, key_step)
        goes = (i < count) & ~game.terminated(after)
        return jax.tree.map(lambda new, old: jnp.where(goes, new, old), after, position)

    return jax.lax.fori_loop(0, plies, move, position)
