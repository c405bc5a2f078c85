"""The games of pgx (Koyama et al. 2023, arXiv:2303.17503) as games of ours: the rules are pgx's, boards and names of moves are added.

pgx draws which player id moves first, and computes an observation and checks for illegal actions at every step. Here player 0 moves first,
a position carries no observation (nor a second copy of its legal actions), and neither is computed where nobody asks. That reaches into
pgx, so only the tested versions are taken.
"""

import importlib
from contextlib import AbstractContextManager
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from thorndike.errors import UserError
from thorndike.games.face import Face
from thorndike.games.game import Board, Game, Position

OLDEST, NEWEST = (2, 6), (2, 6)
"""Of pgx: the first and the last minor version that the tests pass with."""
FACES = {
    "hex": ("thorndike.games.placing_boards", "HEX"),
    "go_9x9": ("thorndike.games.placing_boards", "GO_9X9"),
    "go_19x19": ("thorndike.games.placing_boards", "GO_19X19"),
    "chess": ("thorndike.games.chess_boards", "CHESS"),
    "gardner_chess": ("thorndike.games.chess_boards", "GARDNER_CHESS"),
    "shogi": ("thorndike.games.shogi_boards", "SHOGI"),
    "animal_shogi": ("thorndike.games.shogi_boards", "ANIMAL_SHOGI"),
    "backgammon": ("thorndike.games.dice_boards", "BACKGAMMON"),
    "2048": ("thorndike.games.dice_boards", "PLAY_2048"),
}
"""Id -> module and attribute of its face."""
LONGEST = {
    "hex": 122,  # 121 squares, and the swap
    "go_9x9": 162,
    "go_19x19": 722,
    "chess": 512,
    "gardner_chess": 256,
    "shogi": 512,
    "animal_shogi": 256,
    "backgammon": 10_000,  # no rule ends it, but dice do
    "2048": 131_072,  # each move adds 2 or 4 to a board that holds less than 2^18
}
"""Id -> moves of the longest game."""
_HAS_CHANCE = ("backgammon", "2048")
_KEEPS_LEGAL = ("chess", "shogi")
"""Games whose rules keep the legal actions once more, in ``_x``."""

_DOUBLES = {"backgammon": (1, 2, 3, 4, 5)}
"""Actions that do the same as another one: backgammon passes by any of six."""


def _as_pgx_is_written() -> AbstractContextManager[None]:
    """pgx broadcasts between ranks, which the tests do not allow us."""
    return jax.numpy_rank_promotion("allow")


@cache
def pgx_game(id: str) -> Game:
    """The game of a pgx id. Raises UserError where pgx is missing or of an untested version."""
    check_version()
    module, attribute = FACES[id]
    with _as_pgx_is_written():
        import pgx

        env = pgx.make(id)
        face: Face = getattr(importlib.import_module(module), attribute)
        # `env.num_actions` would run it.
        num_actions = jax.eval_shape(env._init, jax.random.key(0)).legal_action_mask.shape[0]
    singles = np.isin(np.arange(num_actions), _DOUBLES.get(id, ()), invert=True)

    def light(state: Position) -> Position:
        """Without what can be computed again, and with types that a loop can carry."""
        nothing = {"observation": jnp.zeros((0,), jnp.float32)}
        nothing |= {"legal_action_mask": jnp.zeros((0,), bool)} if id in _KEEPS_LEGAL else {}
        return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, jnp.asarray(leaf).dtype), state.replace(**nothing))

    def init(key: Key[Array, ""]) -> Position:
        with _as_pgx_is_written():
            state = env._init(key)
        state = state.replace(current_player=jnp.int32(0))
        return light(state.replace(_player_order=jnp.arange(2, dtype=jnp.int32)) if hasattr(state, "_player_order") else state)

    def step(position: Position, action: Int[Array, ""], key: Key[Array, ""]) -> Position:
        with _as_pgx_is_written():
            return light(env._step(position.replace(_step_count=position._step_count + 1), action, key))

    def legal(position: Position) -> Bool[Array, " actions"]:
        mask = position._x.legal_action_mask if id in _KEEPS_LEGAL else position.legal_action_mask
        return mask & singles

    def observe(position: Position) -> Float[Array, "height width channels"]:
        if face.observe is not None:
            return face.observe(position)
        with _as_pgx_is_written():
            seen = env._observe(position, position.current_player).astype(jnp.float32)
        return seen if seen.ndim == 3 else seen[None, None]

    def board(position: Position) -> Board:
        position = jax.device_get(position)
        over = bool(position.terminated)
        return face.board(position, [] if over else np.flatnonzero(legal(position)).tolist())

    shape = jax.eval_shape(lambda key: observe(init(key)), jax.random.key(0)).shape
    return Game(
        id=id,
        num_actions=num_actions,
        observation_shape=shape,
        max_moves=LONGEST[id],
        init=init,
        step=step,
        legal=legal,
        player=lambda position: position.current_player,
        terminated=lambda position: position.terminated,
        rewards=lambda position: position.rewards,
        observe=observe,
        board=board,
        action_name=lambda position, action: face.action_name(position, int(action)),
        symmetries=face.symmetries,
        ownership=face.ownership,
        komi=face.komi,
        num_players=env.num_players,
        has_chance=id in _HAS_CHANCE,
    )


def check_version() -> None:
    """Raises UserError unless pgx is there in a tested version."""
    try:
        found = version("pgx")
    except PackageNotFoundError:
        raise UserError("this game comes from pgx, which is not installed: pip install 'thorndike[games]'") from None
    if not OLDEST <= tuple(int(part) for part in found.split(".")[:2] if part.isdigit()) <= NEWEST:
        window = f"{OLDEST[0]}.{OLDEST[1]}" if OLDEST == NEWEST else f"{OLDEST[0]}.{OLDEST[1]} to {NEWEST[0]}.{NEWEST[1]}"
        raise UserError(f"pgx {found} is installed, but its games are tested with {window}: pip install 'pgx=={NEWEST[0]}.{NEWEST[1]}.*'")
