"""From what a user calls a game or a player to one that can play, before anything heavy is imported."""

import importlib.util
from pathlib import Path

from thorndike.cli.find_run import exists, find_run
from thorndike.errors import UserError
from thorndike.games.player_names import check_player, is_run, known_players, suggestion
from thorndike.games.registry import FOR_ONE, can_be_searched, game, game_ids
from thorndike.records import from_policy, read_policy_facts
from thorndike.suggestions import did_you_mean
from thorndike.training.run_listing import all_runs, read_facts
from thorndike.user_code import lasting_name

GAME_HELP = "a game: connect_four, othello, go_9x9, chess, ...; or yours, path/to/file.py:NAME"
PLAYER_HELP = (
    "random, mcts, mcts:simulations=400, trained, gnugo:level=3, rhino:level=3, gnubg, stockfish:elo=1500, fairy:skill=-10, or a run"
)


def check_game(name: str, alone: bool) -> bool:
    """Whether it is played by one. Raises UserError for a game that is not known, or, unless ``alone`` is right, is played by one."""
    if importlib.util.find_spec("mctx") is None:
        raise UserError("games are searched with mctx, which is not installed: pip install 'thorndike[games]'")
    if ":" in name:
        one = game(name).num_players == 1
    else:
        if name not in game_ids():
            raise UserError(f"unknown game {name!r}{did_you_mean(name, game_ids())}")
        one = name in FOR_ONE
    if one and not alone:
        raise UserError(f"{name} is played by one, so nobody can play against anybody; see: thorndike play {name}")
    return one


def choose_player(text: str, game_name: str, output: Path) -> str | Path:
    """A short name that can play, or the directory of the run meant. Raises UserError for anything else."""
    if not is_run(text):
        check_player(text, game_name, can_be_searched(game_name))
        return text
    if not exists(Path(text)) and text != "latest":
        runs = all_runs(output)
        if not any(text in str(run.relative_to(output)) for run in runs):
            close = suggestion(text, [run.name for run in runs])
            known = f"; did you mean '{close}'?" if close else f"; known: {', '.join(known_players())}, and runs in {output}/"
            raise UserError(f"there is no player '{text}'{known}")
    directory = find_run(text, output)
    from_policy(directory, read_policy_facts)
    trained_on = read_facts(directory).get("environment")
    if trained_on != lasting_name(game_name):
        raise UserError(f"{directory} was trained on {trained_on}, not on {game_name}")
    return directory
