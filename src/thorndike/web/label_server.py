"""A server with the labelling page and its report, behind the gate of the studio."""

import secrets
from collections.abc import Callable

from fastapi import FastAPI

from thorndike.web.home import Door
from thorndike.web.label import Labelling, add_label_page
from thorndike.web.label_report import add_label_report
from thorndike.web.server import serve_app


def serve_labelling(
    labelling: Labelling, host: str, port: int, told: Callable[[str, str], None], token: str | None = None, key: str | None = None
) -> None:
    """Serve until the process is asked to stop. ``told`` gets the address for raters and the owner's, as soon as they answer."""
    owner_key = key or secrets.token_urlsafe(24)
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    add_label_page(app, labelling)
    add_label_report(app, labelling, owner_key)
    serve_app(
        app, host, port, lambda root, shown: told(f"{root}/label?token={shown}", f"{root}/preferences?key={owner_key}&token={shown}"), token
    )


def doors_to(labelling: Labelling, key: str | None = None) -> tuple[Door, ...]:
    """The same two pages for the studio, whose owner is the owner of the judgements, too."""
    owner_key = key or secrets.token_urlsafe(24)
    what = f"Judge {labelling.name}" if labelling.name != "default" else "Judge"
    return (
        Door(what, "say which of two answers, or clips, is better", "/label", lambda app: add_label_page(app, labelling, home="/")),
        Door("Judgements", "how far they are, and what they are worth", f"/preferences?key={owner_key}",
             lambda app: add_label_report(app, labelling, owner_key)),
    )  # fmt: skip
