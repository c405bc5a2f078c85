"""``thorndike play GAME``: a game against an agent, plain search or a program, in the terminal."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.choose_player import GAME_HELP, PLAYER_HELP, check_game, choose_player
from thorndike.cli.find_run import add_output_argument
from thorndike.cli.parser import Parser, seed_number
from thorndike.errors import UserError
from thorndike.games.registry import can_be_searched
from thorndike.games.trained import trained_run

if TYPE_CHECKING:
    from thorndike.cli.terminal_game import TerminalGame

EXAMPLES = """\
  thorndike play connect_four                        against the trained policy that comes with the library
  thorndike play connect_four --against latest       against the newest run
  thorndike play go_9x9 --against gnugo:level=1 --second
While playing: a move by its name, or: moves, hint, undo, save [FILE], quit"""


def run(words: Sequence[str]) -> Answer:
    """Play to the end, or until the person leaves."""
    parser = Parser("play", "Play a game here in the terminal.", EXAMPLES)
    parser.add_argument("game", metavar="GAME", help=GAME_HELP)
    parser.add_argument(
        "--against", metavar="PLAYER", help=f"{PLAYER_HELP} (default: the policy that comes with the game, else mcts, else random)"
    )
    parser.add_argument("--simulations", type=seed_number, default=64, help="searched by runs and mcts for a move (default: 64)")
    parser.add_argument("--second", action="store_true", help="let the other one move first")
    parser.add_argument("--seed", type=seed_number, default=0, help="the number that dice and random moves follow from (default: 0)")
    add_output_argument(parser)
    options = parser.parse(words)
    against = options.against
    if check_game(options.game, alone=True):
        if against is not None or options.second:
            raise UserError(f"{options.game} is played by one: leave --against and --second out")
    else:
        default = "trained" if trained_run(options.game) else "mcts" if can_be_searched(options.game) else "random"
        against = choose_player(default if against is None else against, options.game, options.output)
    playing = _begin(options.game, against, options.simulations, options.second, options.seed)
    try:
        playing.go()
    finally:
        playing.close()
    return Answer(playing.result(), playing.farewell())


def _begin(game: str, against: str | Path | None, simulations: int, second: bool, seed: int) -> "TerminalGame":
    from thorndike.api.playing import player
    from thorndike.cli.terminal_game import TerminalGame
    from thorndike.games.engines import is_engine
    from thorndike.games.registry import game as find_game

    rules = find_game(game)
    opponent = None if against is None else player(against, game, simulations=simulations, seed=seed)
    adviser = opponent if opponent is not None and opponent.name != "random" else None
    if adviser is None and rules.can_be_searched:
        adviser = player("mcts", rules, simulations=max(simulations, 1), seed=seed)
    compiles = opponent is not None and not (isinstance(against, str) and is_engine(against))
    return TerminalGame(rules, opponent, adviser, 1 if second else 0, seed, compiles)
