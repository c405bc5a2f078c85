"""How judgements are written down: appended in one transaction each, and never twice."""

import time
from collections.abc import Callable, Mapping, Sequence

from sqlalchemy import ColumnElement, Connection, FromClause, and_, func, insert, or_, select, update
from sqlalchemy.exc import IntegrityError

from thorndike.errors import UserError
from thorndike.language.preferences import schema
from thorndike.language.preferences.database import Database
from thorndike.language.preferences.judgements import Response, check_response, ranks_by_position


def judge(database: Database, response: Response) -> int:
    """Write down what a rater said; the number of the row, which is on the disk.

    Raises ``UserError`` for an assignment that does not exist or was judged already (undo it first), and for ranks that do not fit.
    """
    check_response(response)
    number = _once(database, response.request, lambda connection: _judge(connection, response))
    assert number is not None
    return number


def undo(database: Database, rater: int, request: str) -> int | None:
    """Take a rater's last judgement back, by a row that says so; its assignment, or None where there is nothing to take back."""
    number = _once(database, request, lambda connection: _undo(connection, rater, request))
    if number is None:
        return None
    table = schema.judgement
    with database.reading() as connection:
        return int(connection.execute(select(table.c.assignment_id).where(table.c.id == number)).scalar_one())


def add_judged(connection: Connection, item: int, rater: int, ranks: Sequence[int]) -> bool:
    """A judgement that was made elsewhere, by position; whether it is new."""
    asked = schema.assignment
    if connection.execute(select(asked.c.id).where(asked.c.item_id == item, asked.c.rater_id == rater)).scalar() is not None:
        return False
    turn = connection.execute(select(func.count()).where(asked.c.rater_id == rater)).scalar_one()
    shown = list(range(len(ranks)))
    values = {"item_id": item, "rater_id": rater, "turn": turn, "repeated": 0, "shown": shown, "created": time.time()}
    number = connection.execute(insert(asked).values(values).returning(asked.c.id)).scalar_one()
    response = Response(number, "ranking", f"imported {item} {rater}", ranks, client="imported")
    said = {"verdict": response.verdict, "ranks": ranks_by_position(response, shown), "reason": "", "client": response.client}
    _add(connection, number, None, said | {"request": response.request})
    _renew_state(connection, item)
    return True


def standing(table: FromClause) -> ColumnElement[bool]:
    """Of judgements: those that no later one supersedes."""
    later = schema.judgement.alias("later")
    return ~select(later.c.id).where(later.c.supersedes == table.c.id).correlate(table).exists()


def raters_of_item(item: ColumnElement[int], since: ColumnElement[float]) -> ColumnElement[int]:
    """How many raters an item has: those who judged it, and those who were shown it since then. Who skipped it does not count."""
    asked, said = schema.assignment.alias("asked"), schema.judgement.alias("said")
    open_and_fresh = and_(or_(said.c.id.is_(None), said.c.verdict == schema.UNDONE), asked.c.created > since)
    answered = said.c.verdict.not_in(("skip", schema.UNDONE))
    return (
        select(func.count())
        .select_from(asked.outerjoin(said, and_(said.c.assignment_id == asked.c.id, standing(said))))
        .where(asked.c.item_id == item, asked.c.repeated == 0, or_(open_and_fresh, answered))
        .correlate(schema.item)
        .scalar_subquery()
    )


def _once(database: Database, request: str, append: Callable[[Connection], int | None]) -> int | None:
    """What ``append`` adds, or what the same request added before."""
    table = schema.judgement
    query = select(table.c.id).where(table.c.request == request)
    try:
        with database.writing() as connection:
            found = connection.execute(query).scalar()
            return append(connection) if found is None else int(found)
    except (IntegrityError, UserError) as error:
        # Somebody else may have written after the look: the same request, which is answered alike, or another about the same assignment.
        with database.reading() as connection:
            found = connection.execute(query).scalar()
        if found is not None:
            return int(found)
        if isinstance(error, UserError):
            raise
        raise UserError("this was judged from elsewhere at the same moment: load it anew") from error


def _judge(connection: Connection, response: Response) -> int:
    asked = schema.assignment
    assignment = connection.execute(select(asked).where(asked.c.id == response.assignment)).one_or_none()
    if assignment is None:
        raise UserError(f"there is no assignment {response.assignment}")
    ranks = ranks_by_position(response, assignment.shown)
    last = _last(connection, response.assignment)
    if last is not None and last[2] != schema.UNDONE:
        raise UserError(f"assignment {response.assignment} was judged already: undo that first")
    values = {"verdict": response.verdict, "ranks": ranks, "strength": response.strength, "reason": response.reason}
    values |= {"milliseconds": response.milliseconds, "client": response.client, "request": response.request}
    number = _add(connection, response.assignment, last, values)
    _renew_state(connection, assignment.item_id)
    return number


def _undo(connection: Connection, rater: int, request: str) -> int | None:
    table, asked = schema.judgement, schema.assignment
    query = (
        select(table.c.assignment_id, asked.c.item_id)
        .join_from(table, asked, table.c.assignment_id == asked.c.id)
        .where(asked.c.rater_id == rater, table.c.verdict != schema.UNDONE, standing(table))
        .order_by(table.c.id.desc())
    )
    found = connection.execute(query.limit(1)).one_or_none()
    if found is None:
        return None
    values = {"verdict": schema.UNDONE, "reason": "", "client": "", "request": request}
    number = _add(connection, found.assignment_id, _last(connection, found.assignment_id), values)
    _renew_state(connection, found.item_id)
    return number


def _last(connection: Connection, assignment: int) -> tuple[int, int, str] | None:
    """Number, revision and verdict of the judgement that stands."""
    table = schema.judgement
    query = select(table.c.id, table.c.revision, table.c.verdict).where(table.c.assignment_id == assignment)
    found = connection.execute(query.order_by(table.c.revision.desc()).limit(1)).one_or_none()
    return None if found is None else (found.id, found.revision, found.verdict)


def _add(connection: Connection, assignment: int, last: tuple[int, int, str] | None, values: Mapping[str, object]) -> int:
    supersedes, revision = (None, 0) if last is None else (last[0], last[1] + 1)
    row = {"assignment_id": assignment, "revision": revision, "supersedes": supersedes, "created": time.time(), **values}
    return int(connection.execute(insert(schema.judgement).values(row).returning(schema.judgement.c.id)).scalar_one())


def _renew_state(connection: Connection, item: int) -> None:
    """Done when enough raters have judged it; so that finding the next item need not look at those that are done."""
    table, asked, said = schema.item, schema.assignment, schema.judgement
    answered = (
        select(func.count())
        .select_from(asked.join(said, said.c.assignment_id == asked.c.id))
        .where(asked.c.item_id == item, asked.c.repeated == 0, standing(said), said.c.verdict.not_in(("skip", schema.UNDONE)))
    )
    # The row is held first, so that two raters who end at the same time see each other.
    wanted = connection.execute(select(table.c.wanted).where(table.c.id == item).with_for_update()).scalar_one()
    count = connection.execute(answered).scalar_one()
    connection.execute(update(table).where(table.c.id == item).values(state="done" if count >= wanted else "open"))
