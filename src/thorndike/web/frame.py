"""What every page of the studio has in common: its style sheet, its heading, and how a mistake is told."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from nicegui import app, context, run, ui

from thorndike.errors import UserError
from thorndike.web.controls import Tag, link

STATIC = Path(__file__).parent / "static"
_AT = "/studio"
_Result = TypeVar("_Result")


def serve_static_files() -> None:
    """The style sheet, from this machine as all else."""
    app.add_static_files(_AT, STATIC, max_cache_age=0)


@contextmanager
def frame(title: str) -> Iterator[None]:
    """A page with the heading of the studio; what is made inside is its content."""
    ui.page_title(f"{title} · Thorndike")
    ui.add_head_html(f'<link rel="stylesheet" href="{_AT}/studio.css"><meta name="color-scheme" content="light dark">')
    # Quasar makes all of the page the main part, its heading too.
    around = context.client.content.parent_slot
    assert around is not None
    around.parent.props["role"] = "none"
    with Tag("header", "top"):
        link("Thorndike", "/", "brand").props('aria-label="Thorndike, the studio: home"')
        with Tag("nav", "", "", {"aria-label": "Pages"}):
            link("Games", "/")
    with Tag("main", "page"):
        yield


class Notice:
    """One line, where it is made, that says what went wrong and is spoken at once."""

    def __init__(self) -> None:
        self._line = Tag("p", "notice", "", {"role": "alert"})

    async def doing(self, work: Callable[[], _Result]) -> _Result | None:
        """Do something in a thread, so that the page never waits; a user's mistake is told here. None where it failed.

        Of any other error the page says that there was one; it goes on, to the log.
        """
        try:
            result = await run.io_bound(work)
        except UserError as error:
            self._line.set_text(str(error))
            return None
        except Exception as error:
            self._line.set_text(f"this is a fault of Thorndike's or of the game's ({type(error).__name__}): the terminal says more")
            raise
        self._line.set_text("")
        return result

    def say(self, line: str) -> None:
        """Tell something; an empty line takes it away."""
        self._line.set_text(line)
