"""The labelling page: what raters see, and the few requests by which the page gets items and hands in judgements.

The page keeps what was not acknowledged and sends it again, under the same name, until it is: ``static/label.js``. Nothing here tells who
made a candidate; even a clip's file is asked for by its place on the page.
"""

from html import escape
from pathlib import Path
from typing import Annotated, NamedTuple

from fastapi import FastAPI, Request
from fastapi.responses import FileResponse, JSONResponse, Response
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, ConfigDict, Field

from thorndike.errors import UserError
from thorndike.language.preferences import judgements
from thorndike.language.preferences.assignment import Plan, next_assignments
from thorndike.language.preferences.judgements import Content, Shown
from thorndike.language.preferences.store import Store

STATIC = Path(__file__).parent / "static"
_BRAND = '<span class="brand">Thorndike</span>'
_MOST_AT_ONCE = 20
_LARGEST = 2**31 - 1
"""Number of a row, in PostgreSQL."""
_KINDS_OF_CLIPS = {".mp4": "video", ".webm": "video", ".gif": "image", ".png": "image", ".jpg": "image", ".jpeg": "image", ".webp": "image"}


class Labelling(NamedTuple):
    """What is labelled, and how."""

    store: Store
    project: int
    name: str
    """Of the project."""
    plan: Plan
    media: Path
    """The folder that clips lie in: nothing outside it is ever served."""


class _Asking(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    rater: Annotated[str, Field(max_length=200)]
    count: Annotated[int, Field(ge=1, le=_MOST_AT_ONCE)] = 4


class _Saying(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    rater: Annotated[str, Field(max_length=200)]
    assignment: Annotated[int, Field(ge=0, le=_LARGEST)]
    verdict: str
    request: str
    ranks: Annotated[list[int], Field(max_length=100)] | None = None
    strength: int | None = None
    reason: str = ""
    milliseconds: int | None = None
    client: Annotated[str, Field(max_length=100)] = ""


class _Undoing(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    rater: Annotated[str, Field(max_length=200)]
    request: str


def add_label_page(app: FastAPI, labelling: Labelling, home: str = "") -> None:
    """The page ``/label`` and what it asks for below it; its heading leads to ``home``, if that is given."""
    store, project = labelling.store, labelling.project
    app.mount("/label/static", StaticFiles(directory=STATIC), name="label-static")
    page = (STATIC / "label.html").read_text()
    if home:
        page = page.replace(_BRAND, f'<a class="brand" href="{escape(home)}" aria-label="Thorndike, the studio: home">Thorndike</a>')

    @app.get("/label")
    def label() -> Response:
        return Response(page, media_type="text/html", headers={"cache-control": "no-store"})

    @app.get("/label/about")
    def about() -> dict[str, object]:
        return {"project": labelling.name, "guidelines": store.guidelines(project)}

    @app.post("/label/next")
    def following(asked: _Asking) -> dict[str, object]:
        rater = store.rater(asked.rater)
        shown = store.shown(next_assignments(store, project, rater, asked.count, labelling.plan))
        progress = store.progress(project)
        own = store.progress(project, rater).judgements
        return {"items": [_as_shown(each) for each in shown], "own": own, "done": progress.done, "items_in_all": progress.items}

    @app.post("/label/judge")
    def judge(said: _Saying) -> dict[str, object]:
        if store.rater_of(said.assignment) != store.rater(said.rater):
            raise UserError(f"assignment {said.assignment} is not for {said.rater}")
        values = (said.assignment, said.verdict, said.request, said.ranks, said.strength, said.reason, said.milliseconds, said.client)
        return {"judgement": store.judge(judgements.Response(*values))}

    @app.post("/label/undo")
    def undo(asked: _Undoing) -> dict[str, object]:
        taken_back = store.undo(store.rater(asked.rater), asked.request)
        return {"item": None if taken_back is None else _as_shown(store.shown([taken_back])[0])}

    @app.get("/label/media/{assignment}/{place}")
    def media(assignment: int, place: int) -> Response:
        shown = store.shown([assignment] if 0 <= assignment <= _LARGEST else [])
        if not shown or not 0 <= place < len(shown[0].candidates):
            return Response(status_code=404)
        path = _clip(labelling.media, shown[0].candidates[place])
        return Response(status_code=404) if path is None else FileResponse(path, headers={"cache-control": "private, max-age=3600"})

    @app.exception_handler(UserError)
    def mistaken(request: Request, error: Exception) -> JSONResponse:
        return JSONResponse({"error": str(error)}, status_code=409)


def _as_shown(shown: Shown) -> dict[str, object]:
    candidates = [_as_parts(each, f"/label/media/{shown.assignment}/{place}") for place, each in enumerate(shown.candidates)]
    return {"assignment": shown.assignment, "prompt": _as_parts(shown.prompt, ""), "candidates": candidates}


def _as_parts(content: Content, address: str) -> dict[str, object]:
    """What the page draws of a content; whatever else is in it stays here."""
    parts = {name: content[name] for name in ("text", "messages") if name in content}
    media = content.get("media")
    if isinstance(media, str) and address:
        parts |= {"media": address, "kind": _KINDS_OF_CLIPS.get(Path(media).suffix.lower(), "unknown")}
    return parts


def _clip(folder: Path, content: Content) -> Path | None:
    named = content.get("media")
    if not isinstance(named, str) or Path(named).suffix.lower() not in _KINDS_OF_CLIPS:
        return None
    path = (folder / named).resolve()
    return path if path.is_relative_to(folder.resolve()) and path.is_file() else None
