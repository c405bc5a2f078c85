"""Portable Game Notation of chess (Edwards 1994), by python-chess, which knows the rules once more."""

import importlib
import io
import logging
from types import ModuleType

from thorndike.errors import UserError
from thorndike.games.game_record import GameRecord

_RESULTS = {"1-0": (1.0, -1.0), "0-1": (-1.0, 1.0), "1/2-1/2": (0.0, 0.0)}


def write_pgn(record: GameRecord) -> str:
    """A game of chess as a file. Raises UserError for another game, and where python-chess is missing."""
    chess = _chess()
    if record.game != "chess":
        raise UserError(f"PGN is for chess, not for {record.game}")
    game = chess.Game()
    game.headers.update({"Event": "Thorndike", "Site": "?", "Date": "????.??.??", "Round": "?"})
    game.headers["White"], game.headers["Black"] = record.players
    node = game
    for _, name in record.moves:
        node = node.add_variation(node.board().parse_uci(name))
    names = {score: name for name, score in _RESULTS.items()}
    game.headers["Result"] = "*" if record.result is None else names[record.result]
    return f"{game}\n\n"


def read_pgn(text: str, where: str) -> GameRecord:
    """The main line of the first game in a file. Raises UserError for anything else; ``where`` it comes from."""
    chess = _chess()
    game = chess.read_game(io.StringIO(text))
    if game is None:
        raise UserError(f"{where} is no PGN record: it holds no game")
    if "FEN" in game.headers or game.headers.get("Variant", "Standard") not in ("Standard", "Chess"):
        raise UserError(f"{where}: only chess from its usual beginning is read")
    if game.errors:
        raise UserError(f"{where} is no sound PGN record: {' '.join(str(game.errors[0]).split())[:200]}")
    if not game.variations and "White" not in text:
        raise UserError(f"{where} is no PGN record: it holds no game")
    moves = tuple((ply % 2, move.uci()) for ply, move in enumerate(game.mainline_moves()))
    players = game.headers.get("White", "?"), game.headers.get("Black", "?")
    return GameRecord("chess", players, moves, _RESULTS.get(game.headers.get("Result", "*")))


def _chess() -> ModuleType:
    try:
        # Errors are told by whoever reads; python-chess would log them, too.
        logging.getLogger("chess.pgn").disabled = True
        return importlib.import_module("chess.pgn")
    except ModuleNotFoundError:
        raise UserError("PGN needs python-chess: pip install 'thorndike[games]'") from None
