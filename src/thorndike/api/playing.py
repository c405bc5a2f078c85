"""Games between players: who is who by a short text, matches, and pools of players with ratings."""

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, TypeAlias, cast

import jax

from thorndike.api.loading import LoadedPolicy, load
from thorndike.errors import UserError
from thorndike.games.agent_player import SIMULATIONS, agent_player
from thorndike.games.engines import engine, is_engine
from thorndike.games.game import Game, Player
from thorndike.games.match import Match, as_record
from thorndike.games.match import play_match as play
from thorndike.games.match_file import PlayedGame
from thorndike.games.pgn import write_pgn
from thorndike.games.player_names import MCTS, RANDOM, TRAINED, check_player, mcts_simulations
from thorndike.games.players import mcts_player, random_player
from thorndike.games.registry import game as find_game
from thorndike.games.registry import is_game
from thorndike.games.sgf import can_be_sgf, write_sgf
from thorndike.games.trained import trained_run
from thorndike.statistics.ratings import Games, Ratings, fit_ratings

PlayerLike: TypeAlias = str | Path | Player | LoadedPolicy
Progress: TypeAlias = Callable[[PlayedGame], None]


class Arena(NamedTuple):
    """A pool in which everybody played everybody."""

    players: tuple[str, ...]
    matches: tuple[Match, ...]
    ratings: Ratings
    """By player, in the same order."""


def player(who: PlayerLike, game: Game | str, *, simulations: int = SIMULATIONS, seed: int = 0) -> Player:
    """A player of a game by a text: ``random``, ``mcts:simulations=400``, ``gnugo:level=3``, ``stockfish:elo=1500``, or a run's directory.

    Runs, and ``mcts`` where it does not say, search ``simulations`` positions a move. Raises UserError for one that is not known, or cannot
    play this game.
    """
    rules = find_game(game) if isinstance(game, str) else game
    if isinstance(who, Player):
        return who
    if isinstance(who, str):
        check_player(who, rules.id, rules.can_be_searched)
        if who == RANDOM:
            return random_player(seed)
        if who.partition(":")[0] == MCTS:
            return mcts_player(rules, mcts_simulations(who, simulations), seed)
        if is_engine(who):
            return engine(who, rules.id)
    if who == TRAINED:
        return _agent(TRAINED, load(cast(Path, trained_run(rules.id))), rules, simulations)
    loaded = who if isinstance(who, LoadedPolicy) else load(who)
    trained_on = str(loaded.facts["environment"])
    # A game of the user's own is called by its file or module where it was trained by its name.
    if trained_on != rules.id and not (is_game(trained_on) and find_game(trained_on).id == rules.id):
        raise UserError(f"{loaded.run} was trained on {trained_on}, not on {rules.id}")
    return _agent(loaded.run.name if loaded.run is not None else "agent", loaded, rules, simulations)


def play_match(
    game: Game | str,
    first: PlayerLike,
    second: PlayerLike,
    *,
    games: int = 100,
    simulations: int = SIMULATIONS,
    seed: int = 0,
    opening_plies: int = 2,
    save: str | Path | None = None,
    progress: Progress | None = None,
) -> Match:
    """Two players, ``games`` games: every opening of ``opening_plies`` moves is played twice, with colours swapped.

    ``save`` is a folder in which the games are kept as they end; the same match goes on from there. Raises UserError for wrong players.
    """
    rules = find_game(game) if isinstance(game, str) else game
    if games < 1 or opening_plies < 0 or simulations < 0:
        raise UserError(f"a match needs games >= 1, opening_plies >= 0 and simulations >= 0; got {games}, {opening_plies}, {simulations}")
    sides = player(first, game, simulations=simulations, seed=seed), player(second, game, simulations=simulations, seed=seed + 1)
    try:
        return _played(rules, sides, games, seed, opening_plies, save, progress)
    finally:
        for side in sides:
            side.close()


def arena(
    game: Game | str,
    players: Sequence[PlayerLike],
    *,
    games: int = 20,
    simulations: int = SIMULATIONS,
    seed: int = 0,
    opening_plies: int = 2,
    save: str | Path | None = None,
    progress: Progress | None = None,
) -> Arena:
    """Everybody plays everybody, ``games`` games each, and is rated by all of them together. For the rest see ``play_match``."""
    rules = find_game(game) if isinstance(game, str) else game
    if len(players) < 2:
        raise UserError("an arena needs at least two players")
    if games < 1 or opening_plies < 0 or simulations < 0:
        raise UserError(f"an arena needs games >= 1, opening_plies >= 0 and simulations >= 0; got {games}, {opening_plies}, {simulations}")
    sides = [player(who, game, simulations=simulations, seed=seed + i) for i, who in enumerate(players)]
    try:
        names = _different([side.name for side in sides])
        sides = [side._replace(name=name) for side, name in zip(sides, names, strict=True)]
        pairs = list(combinations(range(len(sides)), 2))
        matches = [_played(rules, (sides[i], sides[j]), games, seed, opening_plies, save, progress) for i, j in pairs]
    finally:
        for side in sides:
            side.close()
    rows = [row for pair, match in zip(pairs, matches, strict=True) for row in _rows(pair, match)]
    return Arena(tuple(names), tuple(matches), fit_ratings(len(sides), rows))


def _played(
    rules: Game,
    sides: tuple[Player, Player],
    games: int,
    seed: int,
    opening_plies: int,
    save: str | Path | None,
    progress: Progress | None,
) -> Match:
    if save is None:
        return play(rules, sides, games, seed, opening_plies, None, progress)
    name = f"{_file_name(sides[0].name)}-{_file_name(sides[1].name)}"
    match = play(rules, sides, games, seed, opening_plies, Path(save) / f"{name}.jsonl", progress)
    records = [as_record(rules, played) for played in match.games]
    if can_be_sgf(rules.id):
        Path(save, f"{name}.sgf").write_text("".join(map(write_sgf, records)), encoding="utf-8")
    elif rules.id == "chess":
        Path(save, f"{name}.pgn").write_text("".join(map(write_pgn, records)), encoding="utf-8")
    return match


def _rows(pair: tuple[int, int], match: Match) -> list[Games]:
    first, second = match.tally.moving_first, match.tally.moving_second
    return [Games(*pair, *first), Games(pair[1], pair[0], second.losses, second.draws, second.wins)]


def _agent(label: str, loaded: LoadedPolicy, rules: Game, simulations: int) -> Player:
    policy = loaded.policy
    actor, statistics = jax.tree.map(lambda leaf: leaf[policy.best], (policy.actors, policy.statistics))
    # Games that are kept are told apart by the players' names: those of another strength must not be taken for this one's.
    label += "" if simulations == SIMULATIONS else f":simulations={simulations}"
    return agent_player(label, rules, policy.algorithm, policy.wrapper, actor, statistics, loaded.facts["config"], simulations)


def _different(names: Sequence[str]) -> list[str]:
    """A number behind a name that is there already."""
    return [name if names[:i].count(name) == 0 else f"{name} #{names[:i].count(name) + 1}" for i, name in enumerate(names)]


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "._=-" else "_" for letter in name)[:80]
