"""The first page: the games there are, those being played, and a saved one to open."""

from collections.abc import Callable, Sequence
from typing import NamedTuple
from urllib.parse import quote

from fastapi import FastAPI
from nicegui import run, ui

from thorndike.games.saved_game import LARGEST
from thorndike.web.controls import Tag, button, link, open_file
from thorndike.web.frame import Notice, frame
from thorndike.web.icons import game_icon
from thorndike.web.looks import look_of
from thorndike.web.setup_form import SetupForm
from thorndike.web.studio import Place, Setup, Studio


class Door(NamedTuple):
    """Pages that are no part of the studio, behind its gate all the same."""

    title: str
    line: str
    """What is there."""
    address: str
    add: Callable[[FastAPI], None]
    """Puts the pages into the studio's app."""


def add_home(studio: Studio, doors: Sequence[Door] = ()) -> None:
    """The pages ``/`` and ``/new/GAME``."""

    @ui.page("/")
    async def home() -> None:
        being_played = await run.io_bound(lambda: _being_played(studio)) or {}
        with frame("Games"):
            notice = Notice()

            async def opened(text: str) -> None:
                if not text:
                    return notice.say(f"that file is empty, or too long for a saved game (more than {LARGEST:,} bytes)")
                name = await notice.doing(lambda: studio.open_saved(text.encode(), "the file"))
                if name is not None:
                    ui.navigate.to(f"/play/{name}")

            Tag("h1", "", "Play")
            Tag("p", "lead", "Against what was trained here, a plain search, or somebody beside you.")
            with Tag("ul", "cards", "", {"aria-label": "Games"}):
                for game_id in studio.games:
                    look = look_of(game_id)
                    with Tag("li"), link("", f"/new/{quote(game_id, safe='')}", "card"):
                        ui.html(game_icon(look.pieces), sanitize=False, tag="span")
                        Tag("strong", "", look.title)
                        Tag("span", "", look.rule)
            if being_played:
                Tag("h2", "", "Games on the table")
                with Tag("ul", "rows"):
                    for name, summary in being_played.items():
                        with Tag("li"):
                            link(summary, f"/play/{name}")
            if doors:
                Tag("h2", "", "Beside the games")
                with Tag("ul", "rows"):
                    for door in doors:
                        with Tag("li"):
                            link(door.title, door.address)
                            Tag("span", "quiet", f" {door.line}")
            Tag("h2", "", "A saved game")
            Tag("p", "quiet", "Step through it, or go on from any of its moves.")
            open_file("Open a file…", ".json,application/json", LARGEST, opened)

    @ui.page("/new/{game_id:path}")
    def new(game_id: str) -> None:
        if game_id not in studio.games:
            with frame("No such game"):
                Tag("h1", "", "There is no such game")
                link("Choose another", "/", "button primary")
            return
        look = look_of(game_id)
        with frame(look.title):
            notice = Notice()
            Tag("h1", "", look.title)
            Tag("p", "lead", look.rule)
            with Tag("section", "panel narrow", "", {"aria-label": "Who plays"}):
                form = SetupForm(studio, Setup(game_id, studio.opponents(game_id)[0].id))

                async def start() -> None:
                    # Games of pgx take some seconds to compile.
                    start_button.set_text("Setting up the board…")
                    start_button.set_attribute("disabled", True)
                    try:
                        name = await notice.doing(lambda: studio.open(form.setup))
                    finally:
                        start_button.set_text("Start")
                        start_button.set_attribute("disabled", None)
                    if name is not None:
                        ui.navigate.to(f"/play/{name}")

                start_button = button("Start", start, "primary")


def _being_played(studio: Studio) -> dict[str, str]:
    """What to say of each table on which something was played."""
    return {name: _summary(place) for name, place in studio.places().items() if place.table.view().moves}


def _summary(place: Place) -> str:
    view, look = place.table.view(), look_of(place.setup.game)
    players = " against ".join(seat.name for seat in view.seats)
    return f"{look.title}: {players}, {len(view.moves)} moves{'' if view.outcome is None else ', over'}"
