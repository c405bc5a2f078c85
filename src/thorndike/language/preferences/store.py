"""A store of judgements on SQLAlchemy: a SQLite file by default, PostgreSQL by URL. What was acknowledged is on the disk.

Judgements are only added. A request that is repeated, because its answer was lost on the way, finds the row that it made.
"""

import contextlib
import hashlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from sqlalchemy import Connection, Row, Table, and_, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from thorndike.errors import UserError
from thorndike.language.preferences import recording, schema
from thorndike.language.preferences.database import Database
from thorndike.language.preferences.judgements import Candidate, Content, Judged, NewItem, Response, Shown
from thorndike.training.json_files import quoted

_LONGEST_NAME = 100


class Progress(NamedTuple):
    """How far a project is."""

    items: int
    done: int
    judgements: int


class Question(NamedTuple):
    """An item as it is stored."""

    prompt: int
    candidates: tuple[int, ...]
    raters: int
    best: int | None


class Store:
    """One store. Any number of threads and processes may have it open at once."""

    def __init__(self, where: str | Path) -> None:
        """``where``: a file's path, or a URL such as ``postgresql://me@host/name``. Raises ``UserError`` for what cannot be opened."""
        self.database = Database(where)

    def close(self) -> None:
        """Give the connections back."""
        self.database.close()

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def project(self, name: str, guidelines: str | None = None) -> int:
        """The project of that name, made where there is none. Guidelines that are given replace the present ones."""
        table = schema.project
        found = self._number(table, _checked_name("a project", name), guidelines="")
        if guidelines is not None:
            with self.database.writing() as connection:
                connection.execute(update(table).where(table.c.id == found).values(guidelines=guidelines))
        return found

    def projects(self) -> dict[str, int]:
        """All projects by name, the oldest first."""
        table = schema.project
        with self.database.reading() as connection:
            return {row.name: row.id for row in connection.execute(select(table.c.name, table.c.id).order_by(table.c.id))}

    def guidelines(self, project: int) -> str:
        """What raters are told."""
        table = schema.project
        with self.database.reading() as connection:
            return str(connection.execute(select(table.c.guidelines).where(table.c.id == project)).scalar_one())

    def rater(self, name: str) -> int:
        """The rater of that name, made where there is none."""
        return self._number(schema.rater, _checked_name("a rater", name))

    def rater_of(self, assignment: int) -> int | None:
        """Whose assignment it is; None if there is none of that number."""
        asked = schema.assignment
        with self.database.reading() as connection:
            return connection.execute(select(asked.c.rater_id).where(asked.c.id == assignment)).scalar_one_or_none()

    def add_items(self, project: int, items: Iterable[NewItem]) -> int:
        """Add questions, all or none of them; how many were new. One with the same prompt and candidates as another is not added again."""
        with self.database.writing() as connection:
            return sum(_add_item(connection, project, item)[1] for item in items)

    def add_judged(self, project: int, rater: int, items: Iterable[tuple[NewItem, Sequence[int]]]) -> tuple[int, int]:
        """Add questions with a rater's ranks, by position, all or none of them; how many questions and how many judgements were new."""
        with self.database.writing() as connection:
            questions = judgements = 0
            for item, ranks in items:
                number, is_new = _add_item(connection, project, item)
                questions += is_new
                judgements += recording.add_judged(connection, number, rater, ranks)
            return questions, judgements

    def set_priorities(self, priorities: Mapping[int, float]) -> None:
        """Which items to ask first: the highest, such as where an ensemble of reward models disagrees most."""
        table = schema.item
        with self.database.writing() as connection:
            for number, priority in priorities.items():
                connection.execute(update(table).where(table.c.id == number).values(priority=float(priority)))

    def judge(self, response: Response) -> int:
        """Write down what a rater said: ``recording.judge``."""
        return recording.judge(self.database, response)

    def undo(self, rater: int, request: str) -> int | None:
        """Take a rater's last judgement back: ``recording.undo``."""
        return recording.undo(self.database, rater, request)

    def judged(self, project: int) -> list[Judged]:
        """Every judgement that stands, the oldest first."""
        said, asked, thing = schema.judgement, schema.assignment, schema.item
        query = (
            select(said, asked.c.shown, asked.c.repeated, thing.c.id.label("item_id"), thing.c.prompt_id, thing.c.best)
            .add_columns(schema.rater.c.name.label("rater"))
            .join_from(said, asked, said.c.assignment_id == asked.c.id)
            .join(thing, asked.c.item_id == thing.c.id)
            .join(schema.rater, asked.c.rater_id == schema.rater.c.id)
            .where(thing.c.project_id == project, recording.standing(said), said.c.verdict != schema.UNDONE)
            .order_by(said.c.id)
        )
        with self.database.reading() as connection:
            candidates = _candidates_by_item(connection, project)
            return [_as_judged(row, candidates[row.item_id]) for row in connection.execute(query)]

    def history(self, assignment: int) -> list[str]:
        """Every verdict that an assignment ever had, the oldest first, those that were taken back and the undoing too."""
        said = schema.judgement
        with self.database.reading() as connection:
            return list(connection.scalars(select(said.c.verdict).where(said.c.assignment_id == assignment).order_by(said.c.revision)))

    def contents(self, project: int) -> tuple[dict[int, Content], dict[int, Candidate]]:
        """The content of every prompt, and every candidate, by number."""
        said, made = schema.prompt, schema.candidate
        of_prompts = select(said.c.id, said.c.content).where(said.c.project_id == project)
        of_candidates = select(made).join(said, made.c.prompt_id == said.c.id).where(said.c.project_id == project)
        with self.database.reading() as connection:
            prompts = {row.id: row.content for row in connection.execute(of_prompts)}
            return prompts, {row.id: Candidate(row.content, row.made_by, row.details) for row in connection.execute(of_candidates)}

    def questions(self, project: int) -> dict[int, Question]:
        """Every item by number, the oldest first."""
        thing = schema.item
        with self.database.reading() as connection:
            candidates = _candidates_by_item(connection, project)
            rows = connection.execute(select(thing).where(thing.c.project_id == project).order_by(thing.c.id))
            return {row.id: Question(row.prompt_id, candidates[row.id], row.wanted, row.best) for row in rows}

    def progress(self, project: int, rater: int | None = None) -> Progress:
        """How many items there are, how many have all the raters they want, and how many judgements stand (of one rater)."""
        thing, said, asked = schema.item, schema.judgement, schema.assignment
        mine = [] if rater is None else [asked.c.rater_id == rater]
        judgements = (
            select(func.count())
            .select_from(said.join(asked, said.c.assignment_id == asked.c.id).join(thing, asked.c.item_id == thing.c.id))
            .where(thing.c.project_id == project, said.c.verdict != schema.UNDONE, recording.standing(said), *mine)
        )
        ordinary = and_(thing.c.project_id == project, thing.c.best.is_(None))
        with self.database.reading() as connection:
            total = connection.execute(select(func.count()).where(ordinary)).scalar_one()
            done = connection.execute(select(func.count()).where(ordinary, thing.c.state == "done")).scalar_one()
            return Progress(total, done, connection.execute(judgements).scalar_one())

    def shown(self, assignments: Sequence[int]) -> list[Shown]:
        """What a rater sees of assignments, in that order: nothing tells who made a candidate, nor whether it is gold or repeated."""
        asked, thing, place = schema.assignment, schema.item, schema.item_candidate
        query = (
            select(asked.c.id, asked.c.shown, schema.prompt.c.content, place.c.position, schema.candidate.c.content.label("candidate"))
            .join_from(asked, thing, asked.c.item_id == thing.c.id)
            .join(schema.prompt, thing.c.prompt_id == schema.prompt.c.id)
            .join(place, place.c.item_id == thing.c.id)
            .join(schema.candidate, place.c.candidate_id == schema.candidate.c.id)
            .where(asked.c.id.in_(assignments))
        )
        prompts: dict[int, Content] = {}
        orders: dict[int, list[int]] = {}
        candidates: dict[int, dict[int, Content]] = {}
        with self.database.reading() as connection:
            for row in connection.execute(query):
                prompts[row.id], orders[row.id] = row.content, row.shown
                candidates.setdefault(row.id, {})[row.position] = row.candidate
        known = [number for number in assignments if number in prompts]
        return [Shown(number, prompts[number], tuple(candidates[number][place] for place in orders[number])) for number in known]

    def _number(self, table: Table, name: str, **others: str) -> int:
        query = select(table.c.id).where(table.c.name == name)
        with self.database.reading() as connection:
            found = connection.execute(query).scalar()
        if found is None:
            # Refused where somebody else makes the same name at the same time: then it is there.
            with contextlib.suppress(IntegrityError), self.database.writing() as connection:
                connection.execute(insert(table).values(name=name, created=time.time(), **others))
            with self.database.reading() as connection:
                found = connection.execute(query).scalar_one()
        return int(found)


def _add_item(connection: Connection, project: int, new: NewItem) -> tuple[int, bool]:
    if len(new.candidates) < 2:
        raise UserError(f"an item has {len(new.candidates)} candidates, but at least 2 can be compared")
    if new.best is not None and not 0 <= new.best < len(new.candidates):
        raise UserError(f"the best candidate of an item is {new.best}, but there are {len(new.candidates)}, counted from 0")
    unnamed = next((each.made_by for each in new.candidates if not each.made_by.isprintable()), None)
    if unnamed is not None:
        raise UserError(f"a candidate is made by {quoted(unnamed)}, but names of models must be printable")
    if new.raters < 1:
        raise UserError(f"an item is for {new.raters} raters, but at least 1 is needed")
    row = {"project_id": project, "content": dict(new.prompt), "source": new.source or None}
    prompt = _find_or_add(connection, schema.prompt, ("project_id", "fingerprint"), row | {"fingerprint": _fingerprint(new.prompt)})
    candidates = []
    for each in new.candidates:
        row = {"prompt_id": prompt, "content": dict(each.content), "made_by": each.made_by, "details": dict(each.details)}
        keys = ("prompt_id", "fingerprint", "made_by")
        candidates.append(_find_or_add(connection, schema.candidate, keys, row | {"fingerprint": _fingerprint(each.content)}))
    if len(set(candidates)) < len(candidates):
        raise UserError("an item compares a candidate with itself: two of its candidates are the same, and by the same maker")
    mark = hashlib.sha256(f"{prompt}:{sorted(candidates)}".encode()).hexdigest()
    thing = schema.item
    found = connection.execute(select(thing.c.id).where(thing.c.project_id == project, thing.c.fingerprint == mark)).scalar()
    if found is not None:
        return found, False
    values = {"project_id": project, "prompt_id": prompt, "fingerprint": mark, "wanted": new.raters, "priority": new.priority}
    values |= {"best": new.best, "state": "open", "created": time.time()}
    number = connection.execute(insert(thing).values(values).returning(thing.c.id)).scalar_one()
    rows = [{"item_id": number, "position": position, "candidate_id": each} for position, each in enumerate(candidates)]
    connection.execute(insert(schema.item_candidate), rows)
    return number, True


def _find_or_add(connection: Connection, table: Table, keys: Sequence[str], values: Mapping[str, object]) -> int:
    found = connection.execute(select(table.c.id).where(*(table.c[key] == values[key] for key in keys))).scalar()
    if found is None:
        found = connection.execute(insert(table).values({**values, "created": time.time()}).returning(table.c.id)).scalar_one()
    return int(found)


def _fingerprint(content: Content) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _candidates_by_item(connection: Connection, project: int) -> dict[int, tuple[int, ...]]:
    place, thing = schema.item_candidate, schema.item
    query = select(place).join(thing, place.c.item_id == thing.c.id).where(thing.c.project_id == project)
    found: dict[int, list[int]] = {}
    for row in connection.execute(query.order_by(place.c.item_id, place.c.position)):
        found.setdefault(row.item_id, []).append(row.candidate_id)
    return {number: tuple(candidates) for number, candidates in found.items()}


def _as_judged(row: Row, candidates: tuple[int, ...]) -> Judged:
    ranks = None if row.ranks is None else tuple(row.ranks)
    about = (row.item_id, row.prompt_id, candidates, row.rater, row.verdict, ranks, tuple(row.shown), bool(row.repeated))
    return Judged(*about, row.best, row.strength, row.milliseconds, row.reason)


def _checked_name(whose: str, name: str) -> str:
    name = " ".join(name.split())
    if not name or len(name) > _LONGEST_NAME or not name.isprintable():
        raise UserError(f"the name of {whose} is {quoted(name)}, but it must be 1 to {_LONGEST_NAME} printable characters")
    return name
