"""The file of a match: what is played on the first line, then a game a line, written as it ends."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, cast

from thorndike.errors import UserError
from thorndike.training.json_files import TEXT, Kind, check_fields, parse_object, whole

FORMAT = "thorndike-match"
IDENTITIES = "identities"
"""The fact that tells two players of one name apart."""
_SCORE = Kind("1, 0.5 or 0", lambda value: value in (0, 0.5, 1) and not isinstance(value, bool))
_PAIR = Kind("two short texts", lambda value: isinstance(value, list) and len(value) == 2 and all(map(TEXT.admits, value)))


def _is_moves(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(move, list) and len(move) == 2 and move[0] in (0, 1) and TEXT.admits(move[1]) for move in value
    )


_MOVES = Kind("a list of [player, move]", _is_moves)


class PlayedGame(NamedTuple):
    """A game of a match."""

    number: int
    players: tuple[str, str]
    """In the order in which they moved."""
    opening: int
    """Moves that nobody chose."""
    moves: tuple[tuple[int, str], ...]
    """Who played what: 0 or 1, and the move by its name."""
    score: float
    """Of whoever moved first: 1, 0.5 or 0."""
    remark: str = ""
    """Why it ended before its end: somebody resigned, or broke a rule."""


class MatchFile:
    """``read`` first: it also mends what an interruption left half written."""

    def __init__(self, path: Path | None, facts: Mapping[str, object]) -> None:
        """``facts`` are what all games share; without a path nothing is kept."""
        self._path, self._facts = path, {"format": FORMAT, "version": 1, **facts}

    def read(self) -> list[PlayedGame]:
        """The games that are there. Raises UserError for a file of another match, or of something else."""
        if self._path is None:
            return []
        path, beginning = self._path, json.dumps(self._facts).encode()
        try:
            *whole_lines, rest = path.read_bytes().split(b"\n") if path.exists() else [b""]
        except OSError as error:
            raise UserError(f"{path} cannot be read: {error.strerror}") from error
        if not whole_lines:
            if not beginning.startswith(rest):
                raise UserError(f"{path} holds something else, not the games of a match: keep them in another folder")
            _write(path, beginning + b"\n")
            return []
        found = parse_object(whole_lines[0], path)
        for name, value in self._facts.items():
            if name == IDENTITIES and found.get(name) != value:
                raise UserError(
                    f"{path} holds games of a run that has been trained on since, or changed: keep the new ones in another folder"
                )
            if found.get(name) != value:
                raise UserError(f"{path} is of another match: its {name} is {json.dumps(found.get(name))[:60]}, not {json.dumps(value)}")
        if rest:
            _write(path, b"\n".join(whole_lines) + b"\n")
        return [_played(line, f"{path}, line {number}") for number, line in enumerate(whole_lines[1:], start=2)]

    def append(self, played: PlayedGame) -> None:
        """Write a game so that it is there whatever happens next."""
        if self._path is not None:
            with self._path.open("ab") as file:
                file.write(json.dumps(played._asdict()).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())


def _write(path: Path, data: bytes) -> None:
    aside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_bytes(data)
        aside.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error


def _played(line: bytes, where: str) -> PlayedGame:
    content = parse_object(line, where)
    kinds = {"number": whole(0), "players": _PAIR, "opening": whole(0), "moves": _MOVES, "score": _SCORE, "remark": TEXT}
    check_fields(content, kinds, where)
    moves = tuple((int(move[0]), str(move[1])) for move in cast(list[list], content["moves"]))
    first, second = cast(list[str], content["players"])
    opening = cast(int, content["opening"])
    return PlayedGame(
        cast(int, content["number"]), (first, second), opening, moves, cast(float, content["score"]), cast(str, content["remark"])
    )
