"""A game as a file: JSON with the moves by their names, for people and programs to read."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from thorndike.errors import UserError
from thorndike.games.game import Choice, Game, named_action
from thorndike.training.json_files import TEXT, Kind, as_bytes, check_fields, parse_object, whole

FORMAT = "thorndike-game"
LARGEST = 200_000
"""Characters: a long game of chess needs a tenth."""
_TEXTS = Kind("a list of short texts", lambda value: isinstance(value, list) and all(map(TEXT.admits, value)))
_PROBABILITIES = Kind(
    "a list of numbers from 0 to 1, or null",
    lambda value: isinstance(value, list) and all(part is None or (type(part) in (int, float) and 0 <= part <= 1) for part in value),
)


class SavedGame(NamedTuple):
    """What a file holds, not yet checked against the rules of the game."""

    game: str
    seed: int
    """Of the dice."""
    players: tuple[str, ...]
    moves: tuple[str, ...]
    win_probabilities: tuple[float | None, ...]
    """Of the player to move, by position, as far as somebody told."""


def saved_game_file(game: Game, seed: int, players: Sequence[str], moves: Sequence[str], choices: Mapping[int, Choice]) -> bytes:
    """The file of a game as it was played so far."""
    told = [choices[number].win_probability if number in choices else None for number in range(len(moves) + 1)]
    facts = {"format": FORMAT, "version": 1, "game": game.id, "seed": seed, "players": [*players], "moves": [*moves]}
    return as_bytes({**facts, "win_probabilities": told})


def read_saved_game(data: bytes, where: str) -> SavedGame:
    """What a file holds. Raises UserError for one that is no saved game; ``where`` it comes from."""
    if len(data) > LARGEST:
        raise UserError(f"{where} is too long for a saved game: {len(data)} bytes")
    content = parse_object(data, where)
    if content.get("format") != FORMAT:
        raise UserError(f"{where} is no saved game of Thorndike: its 'format' is not {FORMAT!r}")
    kinds = {"game": TEXT, "seed": whole(0, 2**32 - 1), "players": _TEXTS, "moves": _TEXTS, "win_probabilities": _PROBABILITIES}
    check_fields(content, {"version": whole(1, 1), **kinds}, where)
    return SavedGame(
        game=cast(str, content["game"]),
        seed=cast(int, content["seed"]),
        players=tuple(cast(list[str], content["players"])),
        moves=tuple(cast(list[str], content["moves"])),
        win_probabilities=tuple(cast(list[float | None], content["win_probabilities"])),
    )


def saved_actions(game: Game, saved: SavedGame) -> tuple[list[int], dict[int, Choice]]:
    """The moves as actions, and what was told about them. Raises UserError at the first move that the rules do not allow."""
    if len(saved.moves) > game.max_moves:
        raise UserError(f"{len(saved.moves)} moves are more than a game of {game.id} can have")
    key = jax.random.key(saved.seed)
    position, actions = game.init(key), list[int]()
    for number, name in enumerate(saved.moves):
        action = None if bool(game.terminated(position)) else named_action(game, position, name)
        if action is None:
            raise UserError(f"move {number + 1} of the saved game, {name}, is not legal there")
        actions.append(action)
        position = jax.jit(game.step)(position, jnp.int32(action), jax.random.fold_in(key, number))
    told = {
        number: Choice(actions[number] if number < len(actions) else -1, win_probability=probability)
        for number, probability in enumerate(saved.win_probabilities[: len(actions) + 1])
        if probability is not None
    }
    return actions, told
