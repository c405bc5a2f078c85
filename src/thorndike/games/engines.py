"""Programs that nobody here wrote, by short names: ``gnugo:level=3``, ``stockfish:elo=1500``, ``fairy:skill=-10``.

Any other goes by its command: ``gtp:COMMAND``, ``uci:COMMAND``, ``usi:COMMAND``. Nothing is started before its first move.
"""

import os
import shlex
import shutil
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from thorndike.errors import UserError
from thorndike.games.registry import can_be_searched
from thorndike.suggestions import did_you_mean

if TYPE_CHECKING:
    from thorndike.games.engine_player import Start
    from thorndike.games.game import Player

Settings = Mapping[str, int]
MOVE_LIMIT_S = 120.0
"""A move that takes longer is taken for a hanging engine, unless ``limit`` says otherwise."""
_THINKS = {"movetime": (1, 3_600_000), "depth": (1, 100), "nodes": (1, 10**12)}
"""What ends a search: milliseconds, plies, positions."""
_THINKS_BY_DEFAULT = {"movetime": 100}
_VARIANTS = {"gardner_chess": "gardner", "animal_shogi": "dobutsu"}
"""Our ids -> Fairy-Stockfish's names, where they differ."""
_BEYOND_PATH = "/usr/games"
"""Where Debian puts games, which is not on everybody's PATH."""


class Engine(NamedTuple):
    """A program that can be asked for."""

    program: str
    package: str
    """Debian's, that it comes in."""
    games: tuple[str, ...]
    settings: Mapping[str, tuple[int, int]]
    """Name -> least and greatest value."""
    start: Callable[[tuple[str, ...], str, Settings, float], "Start"]
    """Program, game, settings, seconds that a move may take -> how to start it."""
    asked_always: bool = False
    """Whether it is asked even where one move alone is legal."""


def _gnugo(program: tuple[str, ...], game: str, settings: Settings, limit_s: float) -> "Start":
    from thorndike.games.gtp import gtp_start

    command = [*program, "--mode", "gtp", "--chinese-rules", "--positional-superko", "--level", str(settings.get("level", 10))]
    command += ["--seed", str(settings["seed"])] if "seed" in settings else []
    # The komi and the way to count of pgx's Go: what is not captured lives, so GNU Go is not to pass before it has cleaned up.
    return gtp_start(tuple(command), int(game.split("x")[-1]), 7.5, limit_s, generate="kgs-genmove_cleanup")


def _rhino(program: tuple[str, ...], game: str, settings: Settings, limit_s: float) -> "Start":
    from thorndike.games.gtp import gtp_start

    command = [*program, "--level", str(settings.get("level", 3)), "--rand", str(settings.get("random", 0))]
    return gtp_start(tuple(command), 8, None, limit_s, passes_are_told=False)


def _stockfish(program: tuple[str, ...], game: str, settings: Settings, limit_s: float) -> "Start":
    from thorndike.games.uci import uci_start

    options = {"Threads": "1", "Hash": "16"}
    if "elo" in settings:
        options |= {"UCI_LimitStrength": "true", "UCI_Elo": str(settings["elo"])}
    if "skill" in settings:
        options["Skill Level"] = str(settings["skill"])
    return uci_start(program, options, _limit(settings), limit_s)


def _fairy(program: tuple[str, ...], game: str, settings: Settings, limit_s: float) -> "Start":
    from thorndike.games.uci import uci_start

    options = {"UCI_Variant": _VARIANTS.get(game, game), "Threads": "1", "Hash": "16"}
    if "skill" in settings:
        options["Skill Level"] = str(settings["skill"])
    return uci_start(program, options, _limit(settings), limit_s, "usi" if "shogi" in game else "uci")


def _gnubg(program: tuple[str, ...], game: str, settings: Settings, limit_s: float) -> "Start":
    from thorndike.games.gnubg import gnubg_start

    # Plain text, without the opening sound and without the user's own settings.
    return gnubg_start((*program, "--tty", "--quiet", "--no-rc"), settings.get("plies", 0), limit_s)


def _limit(settings: Settings) -> Settings:
    return {name: settings[name] for name in _THINKS if name in settings} or _THINKS_BY_DEFAULT


ENGINES: Mapping[str, Engine] = MappingProxyType(
    {
        "gnugo": Engine("gnugo", "gnugo", ("go_9x9", "go_19x19"), {"level": (1, 10), "seed": (0, 2**31 - 1)}, _gnugo),
        "gnubg": Engine("gnubg", "gnubg", ("backgammon",), {"plies": (0, 4)}, _gnubg, asked_always=True),
        "rhino": Engine("gtp-rhino", "grhino", ("othello",), {"level": (1, 5), "random": (0, 10)}, _rhino),
        "stockfish": Engine("stockfish", "stockfish", ("chess",), {"elo": (1350, 2850), "skill": (0, 20), **_THINKS}, _stockfish),
        "fairy": Engine(
            "fairy-stockfish",
            "fairy-stockfish",
            ("chess", "gardner_chess", "animal_shogi", "shogi"),
            {"skill": (-20, 20), **_THINKS},
            _fairy,
        ),
    }
)
"""Short name -> engine."""
PROTOCOLS = ("gtp", "uci", "usi")
LIMIT = {"limit": (1, 86_400)}
"""Of every engine: seconds that a move may take."""


def engine(text: str, game: str) -> "Player":
    """The player of ``NAME[:key=value,...]`` or ``PROTOCOL:COMMAND`` for a game. Raises UserError where there is none, in one line."""
    from thorndike.games.engine_player import engine_player

    found = ENGINES.get(text.partition(":")[0])
    return engine_player(text, engine_start(text, game), asked_always=found is not None and found.asked_always)


def check_engine(text: str, game: str) -> None:
    """Raises UserError for an engine that cannot play. Nothing heavy is imported, and nothing started."""
    name, _, rest = text.partition(":")
    if name in PROTOCOLS:
        _command(name, rest)
    else:
        found = ENGINES[name]
        read_settings(name, rest, {**found.settings, **LIMIT})
        if game not in found.games:
            others = "random, mcts and" if can_be_searched(game) else "random and"
            raise UserError(f"{name} plays {' and '.join(found.games)}, not {game}; there play {others} trained runs")
        program_of(found)


def engine_start(text: str, game: str) -> "Start":
    """How to start an engine that ``check_engine`` has found right. Raises UserError as that does."""
    check_engine(text, game)
    name, _, rest = text.partition(":")
    if name in PROTOCOLS:
        return _own(name, _command(name, rest), game)
    found = ENGINES[name]
    settings = read_settings(name, rest, {**found.settings, **LIMIT})
    return found.start((program_of(found),), game, settings, float(settings.get("limit", MOVE_LIMIT_S)))


def is_engine(text: str) -> bool:
    """Whether a player's name asks for a program."""
    return text.partition(":")[0] in (*ENGINES, *PROTOCOLS)


def program_of(found: Engine) -> str:
    """Where the program is. Raises UserError, with the package to install, where there is none."""
    path = os.pathsep.join([os.environ.get("PATH", os.defpath), _BEYOND_PATH])
    program = shutil.which(found.program, path=path)
    if program is None:
        raise UserError(f"{found.program} is not installed; on Debian: apt install {found.package}")
    return program


def read_settings(name: str, text: str, known: Mapping[str, tuple[int, int]]) -> Settings:
    """``key=value,...`` of a player. Raises UserError for unknown keys, and values that are no whole numbers within their bounds."""
    settings: dict[str, int] = {}
    for part in text.split(",") if text else ():
        key, equals, value = part.partition("=")
        if key not in known:
            raise UserError(f"{name} has no setting {key!r}{did_you_mean(key, known)}")
        low, high = known[key]
        sign, digits = (-1, value[1:]) if value.startswith("-") else (1, value)
        number = sign * int(digits) if equals and digits.isdecimal() and digits.isascii() and len(digits) < 16 else None
        if number is None or not low <= number <= high:
            raise UserError(f"{name}: {key} is a whole number from {low} to {high}, not {value!r}")
        settings[key] = number
    return settings


def _command(protocol: str, text: str) -> tuple[str, ...]:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise UserError(f"{protocol}:{text} is no command: {error}") from error
    if not words:
        raise UserError(f"{protocol}: must be followed by a command, such as {protocol}:/usr/games/engine")
    program = None if "\0" in words[0] else shutil.which(words[0], path=os.pathsep.join([os.environ.get("PATH", os.defpath), _BEYOND_PATH]))
    if program is None:
        raise UserError(f"there is no program {words[0]!r} for {protocol}:{text}")
    return (program, *words[1:])


def _own(protocol: str, command: tuple[str, ...], game: str) -> "Start":
    if protocol == "gtp":
        from thorndike.games.gtp import gtp_start

        is_go = game.startswith("go_")
        size = int(game.split("x")[-1]) if is_go else 8
        return gtp_start(command, size, 7.5 if is_go else None, MOVE_LIMIT_S, passes_are_told=is_go)
    from thorndike.games.uci import uci_start

    return uci_start(command, {}, _THINKS_BY_DEFAULT, MOVE_LIMIT_S, protocol)
