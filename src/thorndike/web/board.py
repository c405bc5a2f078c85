"""The board: play by clicks or keys, see what the search thinks, go back and forth in the game."""

import asyncio
from collections.abc import Callable
from functools import partial

from nicegui import context, events, run, ui
from nicegui.element import Element

from thorndike.games.saved_game import saved_game_file
from thorndike.games.table import View
from thorndike.web.controls import Handler, Tag, button, checkbox, link, slider
from thorndike.web.frame import Notice, frame
from thorndike.web.looks import look_of
from thorndike.web.picture import Picture, picture
from thorndike.web.probability_line import probability_line
from thorndike.web.setup_form import SetupForm
from thorndike.web.studio import Place, Studio


class BoardElement(Element, component="static/board.js"):
    """The board itself; its properties are those of ``picture.Picture.board``."""


def add_board(studio: Studio) -> None:
    """The page ``/play/NAME`` of a table."""

    @ui.page("/play/{name}")
    async def play(name: str) -> None:
        place = studio.place(name)
        if place is None:
            with frame("No such game"):
                Tag("h1", "", "This game is no longer on the table")
                Tag("p", "lead", "The studio keeps games while it runs. Save those that you want to see again.")
                link("Begin another", "/", "button primary")
            return
        with frame(look_of(place.setup.game).title):
            page = _BoardPage(studio, name, place)
        await page.refresh()


class _BoardPage:
    """One page, in one tab, of a table that others may be looking at too."""

    def __init__(self, studio: Studio, name: str, place: Place) -> None:
        self._studio, self._name, self._table = studio, name, place.table
        self._look = look_of(place.setup.game)
        self._alone = True if self._table.game.num_players == 1 else None
        self._moves: list[tuple[Tag, Tag]] = []
        self._names: tuple[str, ...] = ()
        self._asked, self._newest = False, 0
        with Tag("div", "play"):
            with Tag("section", "board-side", "", {"aria-label": "Board"}):
                self._add_board_side()
            with Tag("aside", "side", "", {"aria-label": "The game"}):
                self._add_side(place)
        self._follow()

    def _add_board_side(self) -> None:
        Tag("h1", "visually-hidden", self._look.title)
        with Tag("div", "status", "", {"aria-live": "polite", "aria-atomic": "true"}):
            self._status = Tag("p", "status-line")
            # In the hint's place while there is something to say: the board stays where it is.
            self._notice = Notice()
            self._hint = Tag("p", "hint")
        self._board = BoardElement()
        self._board.props["name"] = f"{self._look.title}, board: arrow keys move, Enter plays"
        self._board.on("square", self._click)
        self._board.on("press", self._press)
        self._buttons = Tag("div", "actions", "", {"role": "group", "aria-label": "Moves that are no squares"})
        with Tag("div", "actions", "", {"role": "group", "aria-label": "Game"}):
            self._stop = button("Stop thinking", self._doing(lambda: self._table.interrupt()), "primary")
            self._go_on = button("Let it play", self._doing(lambda: self._table.go_on()), "primary")
            self._from_here = button("Play on from here", self._doing(lambda: self._table.play_on_from_here()), "primary", asks=True)
            self._from_here.set_attribute("data-asks", "Play on from here? The moves after this one are lost.")
            self._take_back = button("Take back", self._doing(lambda: self._table.take_back()))
            swap = button("Swap sides", self._doing(lambda: self._studio.swap_sides(self._name)))
            swap.set_attribute("hidden", self._alone)
            self._restart = button("New game", self._doing(lambda: self._table.restart()), asks=True)
            button("Save", self._save)

    def _add_side(self, place: Place) -> None:
        with Tag("div", "players"):
            self._players = [Tag("p", "player") for _ in self._look.sides[: self._table.game.num_players]]
        with Tag("section", "panel", "", {"aria-label": "Win probability"}) as chances:
            with Tag("div", "heading"):
                Tag("h2", "", "Win probability")
                self._chance = Tag("span", "chance")
            self._chances = ui.html("", sanitize=False)
            self._thoughts = checkbox("Show what the search thinks", self._analyse)
            self._analysis = Tag("p", "analysis", "", {"aria-live": "polite"})
        with Tag("section", "panel", "", {"aria-label": "Moves"}):
            Tag("h2", "", "Moves")
            self._list = Tag("ol", "moves")
            with Tag("div", "replay", "", {"role": "group", "aria-label": "Step through the game"}):
                button("«", self._step(lambda view: 0), "icon", {"aria-label": "To the beginning"})
                button(
                    "\N{SINGLE LEFT-POINTING ANGLE QUOTATION MARK}",
                    self._step(lambda view: view.shown - 1),
                    "icon",
                    {"aria-label": "One move back"},
                )
                self._slider = slider("Position: arrow keys step through the game", self._slide)
                button(
                    "\N{SINGLE RIGHT-POINTING ANGLE QUOTATION MARK}",
                    self._step(lambda view: view.shown + 1),
                    "icon",
                    {"aria-label": "One move on"},
                )
                button("»", self._step(lambda view: len(view.moves)), "icon", {"aria-label": "To the last move"})
        with Tag("details", "panel") as others:
            Tag("summary", "", "Change the opponent")
            self._form = SetupForm(self._studio, place.setup)
            button("Change, and play on", self._change)
        for needs_two in (chances, others, *self._players):
            needs_two.set_attribute("hidden", self._alone)

    def _follow(self) -> None:
        """Draw again whenever something changes, in whichever thread or tab; until this page is gone for good."""
        loop, client = asyncio.get_running_loop(), context.client

        def told() -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(ask)

        def ask() -> None:
            if not self._asked and not client.is_deleted:
                self._asked = True
                # Kept by the loop's own set of tasks for as long as it runs.
                tasks.add(task := loop.create_task(self.refresh()))
                task.add_done_callback(tasks.discard)

        tasks: set[asyncio.Task[None]] = set()
        client.on_delete(self._table.listen(told))

    async def refresh(self) -> None:
        """Draw the table as it is now."""
        self._asked = False
        self._newest = number = self._newest + 1
        moment = await run.io_bound(self._look_at)
        # None when the studio ends; and a newer one may have overtaken this.
        if moment is not None and number == self._newest:
            self._draw(*moment)

    def _look_at(self) -> tuple[View, Picture]:
        view = self._table.view()
        return view, picture(self._table.game, view)

    def _draw(self, view: View, drawn: Picture) -> None:
        self._status.set_text(drawn.status)
        self._status.classes(add="thinking" if view.thinking else "", remove="" if view.thinking else "thinking")
        self._hint.set_text(drawn.hint)
        self._board.props.update(drawn.board)
        self._draw_buttons(tuple(view.ply.board.buttons) if drawn.board["playable"] else ())
        self._stop.set_attribute("hidden", None if view.thinking else True)
        self._go_on.set_attribute("hidden", None if view.paused and not drawn.over else True)
        self._restart.set_attribute(
            "data-asks", "Begin a new game? The moves of this one are lost." if view.moves and not drawn.over else None
        )
        self._from_here.set_attribute("hidden", True if view.at_end else None)
        self._take_back.set_attribute("disabled", None if view.moves else True)
        for number, (line, seat) in enumerate(zip(self._players, view.seats, strict=True)):
            line.set_text(f"{self._look.sides[number]}: {seat.name}")
            turn = number == view.ply.player and view.at_end and not drawn.over
            line.classes(replace=f"player of-{self._look.pieces} {('first', 'second')[number]} {'turn' if turn else ''}")
        self._chance.set_text(drawn.chance)
        self._chances.content = probability_line(drawn.probabilities, view.shown, *self._look.sides)
        self._thoughts.set_attribute("checked", view.analyse)
        self._analysis.set_text(drawn.analysis)
        self._draw_moves(view)
        self._form.show(place.setup if (place := self._studio.place(self._name)) else self._form.setup)

    def _draw_buttons(self, names: tuple[str, ...]) -> None:
        if names == self._names:
            return
        self._names = names
        self._buttons.clear()
        with self._buttons:
            for name in names:
                button(name.capitalize(), self._doing(partial(self._table.press, name)))

    def _draw_moves(self, view: View) -> None:
        same = 0
        while same < min(len(self._moves), len(view.names)) and self._moves[same][1].text == view.names[same]:
            same += 1
        for item, _ in self._moves[same:]:
            self._list.remove(item)
        del self._moves[same:]
        with self._list:
            for number in range(same, len(view.names)):
                with Tag("li") as item:
                    self._moves.append((item, button(view.names[number], self._doing(partial(self._table.show, number + 1)), "move")))
        for number, (_, move) in enumerate(self._moves, 1):
            move.set_attribute("aria-current", "step" if number == view.shown else None)
        self._slider.set_attribute("max", len(view.moves))
        self._slider.set_attribute("value", view.shown)
        self._slider.set_attribute("aria-valuetext", f"after move {view.shown} of {len(view.moves)}")

    def _doing(self, work: Callable[[], object]) -> Handler:
        async def handler() -> None:
            await self._notice.doing(work)

        return handler

    def _step(self, to: Callable[[View], int]) -> Handler:
        return self._doing(lambda: self._table.show(to(self._table.view())))

    async def _click(self, said: events.GenericEventArguments) -> None:
        match said.args:
            case [int(row), int(column)]:
                await self._notice.doing(lambda: self._table.click((row, column)))

    async def _press(self, said: events.GenericEventArguments) -> None:
        if isinstance(said.args, str):
            await self._notice.doing(partial(self._table.press, said.args))

    async def _slide(self, value: str) -> None:
        if value.isdecimal():
            await self._notice.doing(lambda: self._table.show(int(value)))

    async def _analyse(self, value: str) -> None:
        await self._notice.doing(lambda: self._table.analyse(value == "true"))

    async def _change(self) -> None:
        await self._notice.doing(lambda: self._studio.change(self._name, self._form.setup))

    async def _save(self) -> None:
        view, game = self._table.view(), self._table.game
        data = saved_game_file(game, self._table.seed, [seat.name for seat in view.seats], view.names, view.choices)
        ui.download.content(data, f"{game.id.rpartition(':')[2]}-{len(view.moves)}-moves.json", "application/json")
