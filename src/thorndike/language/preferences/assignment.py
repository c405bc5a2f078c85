"""Which item a rater gets next, and in which order its candidates are shown.

Now and then it is a gold question, whose answer is known, or one that the same rater has judged long ago, with the sides swapped:
they measure raters, who cannot tell them from the others. Everything drawn follows from the seed, the rater and how far the rater is.
"""

import random
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from sqlalchemy import Connection, Float, Select, and_, bindparam, func, insert, or_, select

from thorndike.errors import UserError
from thorndike.language.preferences import recording, schema
from thorndike.language.preferences.judgements import NewItem
from thorndike.language.preferences.store import Store

_FRESH_S = 1800.0
"""How long an item that was shown, but not judged, waits for its rater before others are asked, too."""


@dataclass(frozen=True)
class Plan:
    """Who is asked what."""

    raters: int = 1  # of an item
    share_to_more: float = 0.15  # of items that go to `more_raters`: what agreement is measured on
    more_raters: int = 3
    gold: float = 0.05  # of a rater's items: gold questions, as long as there are any
    repeats: float = 0.03  # of a rater's items: asked again
    repeat_after: int = 20  # items that lie between, at least
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises ``UserError`` for what cannot be."""
        if not (1 <= self.raters <= self.more_raters or (self.raters >= 1 and self.share_to_more == 0)):
            raise UserError(f"raters is {self.raters} and more_raters {self.more_raters}, but they must be at least 1, and more not fewer")
        if not all(0 <= share <= 1 for share in (self.share_to_more, self.gold, self.repeats)) or self.gold + self.repeats > 1:
            raise UserError("share_to_more, gold and repeats are shares from 0 to 1, gold and repeats together too")
        if self.repeat_after < 1:
            raise UserError(f"repeat_after is {self.repeat_after}, but it must be at least 1")


DEFAULT_PLAN = Plan()


def with_raters(items: Iterable[NewItem], plan: Plan) -> Iterator[NewItem]:
    """The items, each with the number of raters that the plan gives it."""
    draws = random.Random(f"raters {plan.seed}")
    for item in items:
        yield item._replace(raters=max(plan.raters, plan.more_raters) if draws.random() < plan.share_to_more else plan.raters)


def next_assignments(store: Store, project: int, rater: int, count: int, plan: Plan = DEFAULT_PLAN) -> list[int]:
    """The next assignments of a rater, up to ``count``: those not judged yet, the oldest first, then new ones; fewer if items run out."""
    with store.database.writing() as connection:
        # Who holds the project's row chooses alone: two raters must not get the last place of the same item. SQLite has one writer anyway.
        connection.execute(select(schema.project.c.id).where(schema.project.c.id == project).with_for_update())
        waiting = _not_judged(connection, project, rater, count)
        while len(waiting) < count:
            made = _assign(connection, project, rater, plan)
            if made is None:
                break
            waiting.append(made)
        return waiting


def _not_judged(connection: Connection, project: int, rater: int, count: int) -> list[int]:
    asked, said, thing = schema.assignment, schema.judgement, schema.item
    query = (
        select(asked.c.id)
        .select_from(asked.join(thing, asked.c.item_id == thing.c.id))
        .outerjoin(said, and_(said.c.assignment_id == asked.c.id, recording.standing(said)))
        .where(thing.c.project_id == project, asked.c.rater_id == rater, or_(said.c.id.is_(None), said.c.verdict == schema.UNDONE))
    )
    return list(connection.scalars(query.order_by(asked.c.turn).limit(count)))


def _assign(connection: Connection, project: int, rater: int, plan: Plan) -> int | None:
    asked, thing = schema.assignment, schema.item
    turns = select(func.count()).select_from(asked.join(thing, asked.c.item_id == thing.c.id))
    turn = connection.execute(turns.where(asked.c.rater_id == rater, thing.c.project_id == project)).scalar_one()
    name = connection.execute(select(schema.rater.c.name).where(schema.rater.c.id == rater)).scalar_one()
    draws = random.Random(f"{plan.seed} {project} {name} {turn}")
    kind = draws.random()
    if kind < plan.repeats:
        repeated = _to_repeat(connection, project, rater, turn - plan.repeat_after)
        if repeated is not None:
            return _add(connection, repeated[0], rater, turn, repeated[1][::-1], repeated=1)
    item = _gold(connection, project, rater) if plan.repeats <= kind < plan.repeats + plan.gold else None
    item = _ordinary(connection, project, rater) if item is None else item
    if item is None:
        return None
    places = schema.item_candidate
    shown = list(range(connection.execute(select(func.count()).where(places.c.item_id == item)).scalar_one()))
    draws.shuffle(shown)
    return _add(connection, item, rater, turn, shown, repeated=0)


def _ordinary(connection: Connection, project: int, rater: int) -> int | None:
    return connection.execute(_ORDINARY, {"project": project, "rater": rater, "since": time.time() - _FRESH_S}).scalar_one_or_none()


def _gold(connection: Connection, project: int, rater: int) -> int | None:
    return connection.execute(_GOLD, {"project": project, "rater": rater}).scalar_one_or_none()


def _unseen() -> Select[int]:
    asked, thing = schema.assignment.alias("seen"), schema.item
    seen = select(asked.c.id).where(asked.c.item_id == thing.c.id, asked.c.rater_id == bindparam("rater")).correlate(thing).exists()
    return (
        select(thing.c.id).where(thing.c.project_id == bindparam("project"), ~seen).order_by(thing.c.priority.desc(), thing.c.id).limit(1)
    )


# Built once: building a statement takes longer than running it.
_GOLD = _unseen().where(schema.item.c.best.is_not(None))
_ORDINARY = _unseen().where(
    schema.item.c.best.is_(None),
    schema.item.c.state == "open",
    recording.raters_of_item(schema.item.c.id, bindparam("since", type_=Float)) < schema.item.c.wanted,
)


def _to_repeat(connection: Connection, project: int, rater: int, last_turn: int) -> tuple[int, list[int]] | None:
    """Item and order of the oldest assignment that was judged, is no gold question, and was not repeated."""
    asked, said, thing = schema.assignment, schema.judgement, schema.item
    again = asked.alias("again")
    repeated = select(again.c.id).where(again.c.item_id == asked.c.item_id, again.c.rater_id == rater, again.c.repeated == 1)
    query = (
        select(asked.c.item_id, asked.c.shown)
        .select_from(asked.join(thing, asked.c.item_id == thing.c.id).join(said, said.c.assignment_id == asked.c.id))
        .where(thing.c.project_id == project, thing.c.best.is_(None), asked.c.rater_id == rater, asked.c.repeated == 0)
        .where(asked.c.turn < last_turn, recording.standing(said), said.c.ranks.is_not(None), ~repeated.correlate(asked).exists())
    )
    found = connection.execute(query.order_by(asked.c.turn).limit(1)).one_or_none()
    return None if found is None else (found.item_id, found.shown)


def _add(connection: Connection, item: int, rater: int, turn: int, shown: list[int], repeated: int) -> int:
    asked = schema.assignment
    values = {"item_id": item, "rater_id": rater, "turn": turn, "repeated": repeated, "shown": shown, "created": time.time()}
    return int(connection.execute(insert(asked).values(values).returning(asked.c.id)).scalar_one())
