"""What the studio keeps while it runs: the tables, each under a name that nobody can guess. Pages come and go; a table stays."""

import secrets
import threading
import time
from collections.abc import Sequence
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.games.plies import next_ply
from thorndike.games.registry import game as find_game
from thorndike.games.saved_game import read_saved_game, saved_actions
from thorndike.games.seats import Seat, computer, person
from thorndike.games.table import Table
from thorndike.web.opponents import ALONE, ANOTHER_PERSON, PERSON, STRENGTH, Opponent, Opponents, is_for_one

MOST_TABLES = 100
"""The one that was not looked at for the longest time makes room."""
_PATIENCE_S = 1.0
"""How long players may take to leave when the studio ends."""


class Setup(NamedTuple):
    """Who plays what."""

    game: str
    opponent: str = PERSON
    simulations: int = STRENGTH
    person_begins: bool = True


class Place(NamedTuple):
    """A table and how it was set up."""

    table: Table
    setup: Setup


class Studio:
    """All tables. Every method may be called from any thread."""

    def __init__(self, games: Sequence[str], opponents: Opponents) -> None:
        """``games``: the ids, or names, of those on offer; ``opponents``: who plays each of them, besides another person."""
        self.games, self._opponents = tuple(games), opponents
        # A file says what a game calls itself, which for a user's own is not the name it is found by.
        self._by_id = {find_game(name).id if ":" in name else name: name for name in self.games}
        self._places: dict[str, Place] = {}
        self._seen: dict[str, float] = {}
        self._lock = threading.Lock()

    def opponents(self, game_id: str) -> tuple[Opponent, ...]:
        """Who plays a game, the likeliest choice first."""
        return (*self._opponents(game_id), ALONE if is_for_one(game_id) else ANOTHER_PERSON)

    def open(self, setup: Setup) -> str:
        """A new table; its name."""
        table = Table(find_game(setup.game), *self._seats(setup), seed=secrets.randbits(32))
        first = table.view().ply
        # Compiled now, not under somebody's first click.
        next_ply(table.game, first, first.legal[0], table.seed)
        table.begin()
        return self._keep(Place(table, setup))

    def open_saved(self, data: bytes, where: str) -> str:
        """A table with a saved game on it, between persons, looked at from its beginning; its name. Raises UserError for a wrong file."""
        saved = read_saved_game(data, where)
        if saved.game not in self._by_id:
            raise UserError(f"{where} holds a game of {saved.game}, which this studio does not have")
        name = self._by_id[saved.game]
        game = find_game(name)
        actions, choices = saved_actions(game, saved)
        names = [*saved.players, "You", "You"][: game.num_players]
        table = Table(game, [person(name) for name in names], seed=saved.seed)
        table.replay(actions, choices)
        return self._keep(Place(table, Setup(name)))

    def change(self, name: str, setup: Setup) -> None:
        """Seat others at a table; the moves stay."""
        seats, analyst = self._seats(setup)
        with self._lock:
            place = self._known(name)
            self._places[name] = place._replace(setup=setup)
        place.table.seat(seats, analyst)

    def swap_sides(self, name: str) -> None:
        """Everybody at a table takes the next seat; the moves stay."""
        with self._lock:
            place = self._known(name)
            place.table.swap_sides()
            self._places[name] = place._replace(setup=place.setup._replace(person_begins=not place.setup.person_begins))

    def place(self, name: str) -> Place | None:
        """A table by its name."""
        with self._lock:
            if name in self._places:
                self._seen[name] = time.monotonic()
            return self._places.get(name)

    def places(self) -> dict[str, Place]:
        """All tables, the one looked at last first."""
        with self._lock:
            return {name: self._places[name] for name in sorted(self._places, key=lambda name: -self._seen[name])}

    def close(self) -> None:
        """Nobody plays any more; engines are ended."""
        ends = time.monotonic() + _PATIENCE_S
        for thread in [thread for place in self.places().values() for thread in place.table.close()]:
            thread.join(max(0.0, ends - time.monotonic()))

    def _known(self, name: str) -> Place:
        if name not in self._places:
            raise UserError("this game is no longer on the table")
        return self._places[name]

    def _keep(self, place: Place) -> str:
        name = secrets.token_urlsafe(9)
        with self._lock:
            self._places[name], self._seen[name] = place, time.monotonic()
            left = sorted(self._places, key=lambda name: -self._seen[name])[MOST_TABLES:]
            dropped = [self._places.pop(name) for name in left]
        for old in dropped:
            old.table.close()
        return name

    def _seats(self, setup: Setup) -> tuple[tuple[Seat, ...], Seat | None]:
        game, offered = find_game(setup.game), self.opponents(setup.game)
        chosen = {each.id: each for each in offered}.get(setup.opponent)
        if chosen is None:
            raise UserError(f"nobody called {setup.opponent} plays {setup.game}")
        searching = next((each for each in offered if each.searches and each.make is not None), None)
        if game.num_players == 1:
            return (person(),), _analyst(searching, setup)
        if chosen.make is None:
            return (person("First"), person("Second")), _analyst(searching, setup)
        seat = computer(chosen.make(game, setup.simulations))
        analyst = seat if chosen.searches else _analyst(searching, setup)
        return (person(), seat) if setup.person_begins else (seat, person()), analyst


def _analyst(opponent: Opponent | None, setup: Setup) -> Seat | None:
    if opponent is None or opponent.make is None:
        return None
    return computer(opponent.make(find_game(setup.game), setup.simulations))
