"""Matches: the same openings with colours swapped, every game written down as it ends, and gone on with after an interruption."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import jax
import numpy as np

from thorndike.errors import UserError
from thorndike.games.game import Game, Player, Position, Turn
from thorndike.games.game_record import GameRecord
from thorndike.games.match_file import IDENTITIES, MatchFile, PlayedGame
from thorndike.games.tally import Tally, tally

Progress: TypeAlias = Callable[[PlayedGame], None]

_DRAWN_OPENINGS = 200


class Match(NamedTuple):
    """All games between two players."""

    players: tuple[str, str]
    games: tuple[PlayedGame, ...]
    """By number; in those with an odd one the second player moves first."""
    tally: Tally
    """Of the first player."""


class Compiled(NamedTuple):
    """A game's functions as a match calls them."""

    game: Game
    init: Callable[[int], Position]
    """Seed -> the beginning."""
    step: Callable[[Position, int, int, int], Position]
    """Position, action, seed, number of the move."""
    legal: Callable[[Position], np.ndarray]
    """Actions, none when the game is over."""
    mover: Callable[[Position], int]
    """0 or 1."""
    rewards: Callable[[Position], tuple[float, float]]


def compiled(game: Game) -> Compiled:
    """Compiled when they are first called."""

    init, player, rewards = jax.jit(game.init), jax.jit(game.player), jax.jit(game.rewards)
    look = jax.jit(lambda position: game.legal(position) & ~game.terminated(position))
    move = jax.jit(lambda position, action, seed, number: game.step(position, action, jax.random.fold_in(jax.random.key(seed), number)))

    def both(position: Position) -> tuple[float, float]:
        first, second = np.asarray(rewards(position)).tolist()
        return first, second

    return Compiled(
        game,
        init=lambda seed: init(jax.random.key(seed)),
        step=lambda position, action, seed, number: move(position, np.int32(action), np.uint32(seed % 2**32), np.int32(number)),
        legal=lambda position: np.flatnonzero(look(position)),
        mover=lambda position: int(player(position)),
        rewards=both,
    )


def openings(rules: Compiled, plies: int, seed: int) -> list[tuple[int, ...]]:
    """All beginnings of so many moves that do not end the game, in an order drawn from ``seed``; beyond 2 moves some drawn ones.

    A game with dice begins differently anyway: there it is the beginning alone.
    """
    random = np.random.default_rng(seed)
    if plies == 0 or rules.game.has_chance:
        return [()]
    if plies <= 2:
        found = _all_openings(rules, rules.init(0), plies)
        random.shuffle(found)
    else:
        drawn = (_random_opening(rules, plies, random) for _ in range(_DRAWN_OPENINGS))
        found = list(dict.fromkeys(opening for opening in drawn if opening is not None))
    if not found:
        raise UserError(f"no game of {rules.game.id} lasts {plies} moves: give fewer opening moves")
    return found


def play_match(
    game: Game,
    players: tuple[Player, Player],
    games: int,
    seed: int = 0,
    opening_plies: int = 2,
    path: Path | None = None,
    progress: Progress | None = None,
) -> Match:
    """``games`` games in pairs: the same opening, colours swapped. With a ``path`` they are kept there, and those that are there count.

    A game in which a player cannot go on is not counted; the second in succession raises its ``UserError``, as does a file of another
    match.
    """
    if game.num_players != 2:
        raise UserError(f"a match is between two players, and {game.id} is played by one")
    rules, names = compiled(game), (players[0].name, players[1].name)
    facts: dict[str, object] = {"game": game.id, "players": [*names], "seed": seed, "opening_plies": opening_plies}
    if any(player.identity for player in players):
        facts[IDENTITIES] = [player.identity for player in players]
    file = MatchFile(path, facts)
    done = {played.number: played for played in file.read() if played.number < games}
    begun = itertools.cycle(openings(rules, opening_plies, seed))
    failed = False
    for number, opening in enumerate(itertools.islice(_twice(begun), games)):
        if number in done:
            continue
        order = players if number % 2 == 0 else players[::-1]
        try:
            played = play_game(rules, order, number, opening, seed + number // 2)
        except UserError:
            if failed:
                raise
            failed = True
            continue
        failed = False
        done[number] = played
        file.append(played)
        if progress is not None:
            progress(played)
    ordered = tuple(done[number] for number in sorted(done))
    return Match(names, ordered, tally([(played.number % 2, played.score) for played in ordered]))


def play_game(rules: Compiled, players: tuple[Player, Player], number: int, opening: Sequence[int], seed: int) -> PlayedGame:
    """One game after an opening; ``players`` in the order in which they move. Raises UserError where one of them cannot go on."""
    game, position = rules.game, rules.init(seed)
    moves: list[int] = []
    earlier: list[Position] = []
    names: list[str] = []
    movers: list[int] = []
    remark, rewards = "", None
    while len(legal := rules.legal(position)):
        mover = rules.mover(position)
        if len(moves) < len(opening):
            action = int(opening[len(moves)])
        else:
            choice = players[mover].choose(Turn(game, position, tuple(moves), tuple(earlier)))
            action, remark = choice.action, choice.remark
            if not choice.resigns and action not in legal:
                choice = choice._replace(resigns=True)
                remark = f"{players[mover].name} forfeits: action {action} is not legal"
            if choice.resigns:
                rewards = (-1.0, 1.0) if mover == 0 else (1.0, -1.0)
                break
        names.append(game.action_name(position, action))
        movers.append(mover)
        earlier.append(position)
        position = rules.step(position, action, seed, len(moves))
        moves.append(action)
    first, second = rewards or rules.rewards(position)
    score = 0.5 if first == second else float(first > second)
    return PlayedGame(number, (players[0].name, players[1].name), len(opening), tuple(zip(movers, names, strict=True)), score, remark)


def as_record(game: Game, played: PlayedGame) -> GameRecord:
    """A game of a match, to be written in the format of its game."""
    return GameRecord(game.id, played.players, played.moves, (2 * played.score - 1, 1 - 2 * played.score))


def _twice(begun: Iterator[tuple[int, ...]]) -> Iterator[tuple[int, ...]]:
    return itertools.chain.from_iterable((opening, opening) for opening in begun)


def _all_openings(rules: Compiled, position: Position, plies: int) -> list[tuple[int, ...]]:
    legal = rules.legal(position)
    if plies == 0:
        return [()] if len(legal) else []
    after = ((int(action), rules.step(position, int(action), 0, 0)) for action in legal)
    return [(action, *rest) for action, following in after for rest in _all_openings(rules, following, plies - 1)]


def _random_opening(rules: Compiled, plies: int, random: np.random.Generator) -> tuple[int, ...] | None:
    position, found = rules.init(0), []
    for number in range(plies):
        legal = rules.legal(position)
        if len(legal) == 0:
            return None
        found.append(int(random.choice(legal)))
        position = rules.step(position, found[-1], 0, number)
    return tuple(found) if len(rules.legal(position)) else None
