"""``thorndike arena GAME PLAYER PLAYER...``: everybody plays everybody, with results by colour and ratings."""

import math
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.choose_player import GAME_HELP, PLAYER_HELP, check_game, choose_player
from thorndike.cli.find_run import add_output_argument
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.cli.tables import table
from thorndike.errors import UserError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from thorndike.api.playing import Arena, Progress
    from thorndike.games.match import Match
    from thorndike.games.tally import Counts

EXAMPLES = """\
  thorndike arena connect_four latest mcts:simulations=1000 --games 100
  thorndike arena othello latest rhino:level=1 rhino:level=3 --games 200 --save othello-games
  thorndike arena chess latest stockfish:elo=1500,movetime=50 --json"""


def run(words: Sequence[str]) -> Answer:
    """Play, and say who is how strong."""
    parser = Parser("arena", "Let players of a game play each other, and rate them.", EXAMPLES)
    parser.add_argument("game", metavar="GAME", help=GAME_HELP)
    parser.add_argument("players", metavar="PLAYER", nargs="+", help=PLAYER_HELP)
    parser.add_argument("--games", type=positive_whole, default=20, help="games of each pair, half with swapped colours (default: 20)")
    parser.add_argument("--simulations", type=seed_number, default=64, help="searched by runs and mcts for a move; 0: none (default: 64)")
    parser.add_argument("--opening-plies", type=seed_number, default=2, help="moves of the openings, which nobody chooses (default: 2)")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that openings and random moves follow from (default: 0)")
    parser.add_argument("--save", metavar="DIR", type=Path, help="keep every game there as it ends, and go on with those that are there")
    add_output_argument(parser)
    options = parser.parse(words)
    if len(options.players) < 2:
        raise UserError("arena needs at least two players, such as `thorndike arena connect_four random mcts`")
    check_game(options.game, alone=False)
    chosen = [choose_player(text, options.game, options.output) for text in options.players]
    if options.save is not None and options.save.exists() and not options.save.is_dir():
        raise UserError(f"--save {options.save} is not a folder")
    from thorndike.api.playing import arena

    with ExitStack() as stack:
        pairs = len(chosen) * (len(chosen) - 1) // 2
        found = arena(
            options.game,
            chosen,
            games=options.games,
            simulations=options.simulations,
            seed=options.seed,
            opening_plies=options.opening_plies,
            save=options.save,
            progress=_bar(stack, pairs * options.games),
        )
    return Answer(_data(options.game, found), _draw(found))


def _bar(stack: ExitStack, games: int) -> "Progress | None":
    """A progress bar, where somebody is looking."""
    if not sys.stderr.isatty():
        return None
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("games"), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    bar = stack.enter_context(Progress(*columns, console=Console(stderr=True), transient=True))
    task = bar.add_task("games", total=games)
    return lambda played: bar.advance(task)


def _data(game: str, found: "Arena") -> dict[str, object]:
    rated = zip(found.players, found.ratings.players, strict=True)
    players = [
        {"player": name, "elo": rating.elo, "ci95": (rating.low, rating.high), "games": rating.games, "score": rating.score}
        for name, rating in rated
    ]
    return {"game": game, "players": players, "first_move_elo": found.ratings.first_move, "matches": list(map(_match_data, found.matches))}


def _match_data(match: "Match") -> dict[str, object]:
    told = match.tally
    return {
        "players": match.players,
        **told.total._asdict(),
        "score": told.score,
        "score_ci95": told.score_ci95,
        "elo": told.elo,
        "elo_ci95": told.elo_ci95,
        "moving_first": told.moving_first._asdict(),
        "moving_second": told.moving_second._asdict(),
        "remarks": [f"game {played.number + 1}: {played.remark}" for played in match.games if played.remark],
    }


def _draw(found: "Arena") -> "RenderableType":
    from rich.console import Group
    from rich.markup import escape

    order = sorted(range(len(found.players)), key=lambda i: -found.ratings.players[i].elo)
    rated = []
    for i in order:
        rating = found.ratings.players[i]
        interval = f"{_elo(rating.elo)} [{_elo(rating.low)}, {_elo(rating.high)}]"
        rated.append({"player": found.players[i], "Elo [95 %]": interval, "games": rating.games, "score": f"{rating.score:.1%}"})
    matches = []
    for match in found.matches:
        told = match.tally
        row: dict[str, object] = {"match": " - ".join(match.players), "won-drawn-lost": _counts(told.total)}
        row |= {"score [95 %]": f"{told.score:.1%} [{told.score_ci95[0]:.1%}, {told.score_ci95[1]:.1%}]"}
        row |= {"moving first": _counts(told.moving_first), "moving second": _counts(told.moving_second)}
        row["Elo [95 %]"] = f"{_elo(told.elo)} [{_elo(told.elo_ci95[0])}, {_elo(told.elo_ci95[1])}]"
        matches.append(row)
    remarks = sorted({played.remark for match in found.matches for played in match.games if played.remark})
    return Group(table(rated), "", table(matches), *(escape(f"note: {remark}") for remark in remarks[:10]))


def _counts(counts: "Counts") -> str:
    return f"{counts.wins}-{counts.draws}-{counts.losses}"


def _elo(value: float) -> str:
    # Whole numbers have no -0.
    return f"{round(value):+d}" if math.isfinite(value) else "?" if math.isnan(value) else "+inf" if value > 0 else "-inf"
