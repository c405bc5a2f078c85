"""The Smart Game Format, FF[4] (Hollosi 1999), of Go, Othello, Hex and Connect Four: the main line of a record, without set-up stones.

Connect Four has no number in the format: its records name it in ``GN``, and a move is its column's letter.
"""

import re
from collections.abc import Mapping
from typing import TypeAlias

from thorndike.errors import UserError
from thorndike.games.game_record import GameRecord

Node: TypeAlias = Mapping[str, list[str]]
_NUMBERS = {"1": "go", "2": "othello", "11": "hex"}
_GAMES = {"go_9x9": ("1", 9), "go_19x19": ("1", 19), "othello": ("2", 8), "hex": ("11", 11), "connect_four": (None, 7)}
"""Id -> number in the format, size of the board."""
_POINTS = "abcdefghijklmnopqrstuvwxyz"
_GO_LETTERS = "ABCDEFGHJKLMNOPQRST"
_COLOURS = "BW"
_LONGEST = 1_000_000
"""Characters of a record."""
_TOKEN = re.compile(r"\s*(?:(?P<mark>[();])|(?P<name>[A-Za-z]+)|\[(?P<value>(?:[^\\\]]|\\.)*)\])", re.DOTALL)


def can_be_sgf(game: str) -> bool:
    """Whether records of this game can be written."""
    return game in _GAMES


def write_sgf(record: GameRecord) -> str:
    """A record as a file. Raises UserError for a game that the format is not used for here."""
    if record.game not in _GAMES:
        raise UserError(f"games of {record.game} are not written as SGF; it is for {', '.join(_GAMES)}")
    number, size = _GAMES[record.game]
    black, white = map(_escaped, record.players)
    head = ["FF[4]", "CA[UTF-8]", "AP[Thorndike]", f"GM[{number}]" if number else "", f"GN[{record.game}]", f"SZ[{size}]"]
    head += [f"PB[{black}]", f"PW[{white}]"]
    if record.game.startswith("go"):
        head += ["KM[7.5]", "RU[Tromp-Taylor]"]
    if record.result is not None:
        head.append(f"RE[{'B+' if record.result[0] > 0 else 'W+' if record.result[0] < 0 else '0'}]")
    moves = [f";{_COLOURS[player]}[{_written(record.game, size, name)}]" for player, name in record.moves]
    lines = ["".join(moves[i : i + 10]) for i in range(0, len(moves), 10)]
    return "\n".join(["(;" + "".join(head), *lines]) + ")\n"


def read_sgf(text: str, where: str) -> GameRecord:
    """The main line of the first game in a file. Raises UserError for anything else, and for set-up stones; ``where`` it comes from."""
    nodes = _main_line(text, where)
    root = nodes[0]
    game, size = _game_of(root, where)
    moves: list[tuple[int, str]] = []
    for number, node in enumerate(nodes):
        if {"AB", "AW", "AE"} & set(node):
            raise UserError(f"{where}: stones set up beside the moves (handicap) are not read")
        for player, colour in enumerate(_COLOURS):
            moves += [(player, _read(game, size, value, f"{where}: node {number + 1}")) for value in node.get(colour, ())]
    result = {"B": (1.0, -1.0), "W": (-1.0, 1.0), "0": (0.0, 0.0), "D": (0.0, 0.0)}.get(root.get("RE", ["?"])[0][:1])
    return GameRecord(game, (root.get("PB", ["black"])[0], root.get("PW", ["white"])[0]), tuple(moves), result)


def _game_of(root: Node, where: str) -> tuple[str, int]:
    named, number = root.get("GN", [""])[0], root.get("GM", ["1"])[0]
    game = named if named in _GAMES and _GAMES[named][0] == root.get("GM", [None])[0] else _NUMBERS.get(number, "")
    size = root.get("SZ", ["19" if game == "go" else ""])[0]
    if game == "go":
        game = f"go_{size}x{size}"
    if game not in _GAMES or size not in ("", str(_GAMES[game][1])):
        raise UserError(f"{where} is a game (GM[{number[:9]}], size {size[:9] or '?'}) that is not read; known: {', '.join(_GAMES)}")
    return game, _GAMES[game][1]


def _written(game: str, size: int, name: str) -> str:
    if name == "pass":
        return ""
    if game.startswith("go"):
        return _POINTS[_GO_LETTERS.index(name[0])] + _POINTS[size - int(name[1:])]
    if game == "othello":
        return name[0] + _POINTS[int(name[1:]) - 1]
    return "swap-pieces" if name == "swap" else name


def _read(game: str, size: int, value: str, where: str) -> str:
    """A move's name."""
    if game in ("hex", "connect_four"):
        return "swap" if value == "swap-pieces" else value
    if value == "" or value.lower() == "pass" or (value == "tt" and size <= 19):
        return "pass"
    if len(value) != 2 or not set(value) <= set(_POINTS[:size]):
        raise UserError(f"{where}: {value[:20]!r} is no point of the board")
    column, row = (_POINTS.index(letter) for letter in value)
    return f"{_GO_LETTERS[column]}{size - row}" if game.startswith("go") else f"{_POINTS[column]}{row + 1}"


def _main_line(text: str, where: str) -> list[dict[str, list[str]]]:
    """The nodes along the first variation everywhere."""
    start = text.find("(")
    if len(text) > _LONGEST or start < 0:
        raise UserError(f"{where} is no SGF record: " + ("it is too long" if start >= 0 else "it has no game tree"))
    nodes: list[dict[str, list[str]]] = []
    name, at = "", start
    while at < len(text):
        token = _TOKEN.match(text, at)
        if token is None:
            raise UserError(f"{where} is no SGF record: unreadable at character {at + 1}")
        at = token.end()
        if token["mark"] == ")":
            # The first end of a variation ends the main line.
            break
        elif token["mark"] == ";":
            nodes.append({})
        elif token["name"]:
            name = "".join(letter for letter in token["name"] if letter.isupper())
        elif token["value"] is not None and nodes and name:
            nodes[-1].setdefault(name, []).append(_plain(token["value"]))
    else:
        raise UserError(f"{where} is no SGF record: it is not closed")
    if not nodes:
        raise UserError(f"{where} is no SGF record: it has no node")
    return nodes


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("]", "\\]")


def _plain(value: str) -> str:
    return re.sub(r"\\(?:\r\n|\n|\r)", "", value).replace("\\\\", "\0").replace("\\", "").replace("\0", "\\")
