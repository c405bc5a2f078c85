"""Who sits at a table: a person, or a player that thinks by itself."""

import threading
from collections.abc import Iterable
from typing import NamedTuple

from thorndike.games.game import Player


class Seat(NamedTuple):
    """Somebody at the table: a person at a page, or a player that is asked."""

    name: str
    player: Player | None = None
    """None: a person."""
    busy: "threading.Lock | None" = None
    """Held while the player thinks; no player is asked twice at a time."""


def person(name: str = "You") -> Seat:
    """A seat for whoever is at the page."""
    return Seat(name)


def computer(player: Player) -> Seat:
    """A seat for a player that thinks by itself."""
    return Seat(player.name, player, threading.Lock())


def leave(seats: Iterable[Seat]) -> list[threading.Thread]:
    """Close players that are needed no more, each as soon as it has ended thinking: in threads, which are given back."""
    alone = {id(seat.player): seat for seat in seats if seat.player is not None}.values()
    threads = [threading.Thread(target=_close, args=(seat,), daemon=True, name=f"closing {seat.name}") for seat in alone]
    for thread in threads:
        thread.start()
    return threads


def _close(seat: Seat) -> None:
    assert seat.player is not None and seat.busy is not None
    with seat.busy:
        seat.player.close()
