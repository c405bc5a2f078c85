"""The tables of a preference store. Rows are only ever added; what may change is an item's state and its priority.

What is compared is content of any kind: an object with ``text``, ``messages`` or ``media`` in it. No table knows which.
"""

from sqlalchemy import JSON, CheckConstraint, Column, Float, ForeignKey, Index, Integer, MetaData, Table, Text, UniqueConstraint

VERSION = 1
"""Of these tables. A store that a newer version made is refused."""

VERDICTS = ("a", "b", "tie", "both_bad", "ranking", "skip")
"""What a rater may say. ``a`` is what was shown first; ``both_bad`` counts as a tie; ``ranking`` comes with ranks."""
UNDONE = "undone"
"""The verdict of the row that an undo adds."""

METADATA = MetaData()

store_version = Table("store_version", METADATA, Column("version", Integer, primary_key=True))

project = Table(
    "project",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("guidelines", Text, nullable=False),
    Column("created", Float, nullable=False),
)

prompt = Table(
    "prompt",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("project_id", ForeignKey("project.id"), nullable=False),
    Column("fingerprint", Text, nullable=False),
    Column("content", JSON, nullable=False),
    Column("source", Text),
    Column("created", Float, nullable=False),
    UniqueConstraint("project_id", "fingerprint"),
)

candidate = Table(
    "candidate",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("prompt_id", ForeignKey("prompt.id"), nullable=False),
    Column("fingerprint", Text, nullable=False),
    Column("content", JSON, nullable=False),
    Column("made_by", Text, nullable=False),  # the model, never shown to raters; empty where nobody said
    Column("details", JSON, nullable=False),  # seed, temperature, log-probability: whatever its maker knows
    Column("created", Float, nullable=False),
    UniqueConstraint("prompt_id", "fingerprint", "made_by"),
)

item = Table(
    "item",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("project_id", ForeignKey("project.id"), nullable=False),
    Column("prompt_id", ForeignKey("prompt.id"), nullable=False),
    Column("fingerprint", Text, nullable=False),  # of prompt and candidates: importing the same file twice adds nothing
    Column("wanted", Integer, CheckConstraint("wanted >= 1"), nullable=False),  # raters that it is to have
    Column("priority", Float, nullable=False),
    Column("best", Integer),  # of a gold question: the position of the candidate that is known to be the best
    Column("state", Text, CheckConstraint("state in ('open', 'done')"), nullable=False),
    Column("created", Float, nullable=False),
    UniqueConstraint("project_id", "fingerprint"),
    Index("item_by_priority", "project_id", "state", "priority"),
)

item_candidate = Table(
    "item_candidate",
    METADATA,
    Column("item_id", ForeignKey("item.id"), primary_key=True),
    Column("position", Integer, primary_key=True),
    Column("candidate_id", ForeignKey("candidate.id"), nullable=False),
    UniqueConstraint("item_id", "candidate_id"),
)

rater = Table(
    "rater",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("created", Float, nullable=False),
)

assignment = Table(
    "assignment",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("item_id", ForeignKey("item.id"), nullable=False),
    Column("rater_id", ForeignKey("rater.id"), nullable=False),
    Column("turn", Integer, nullable=False),  # which one this is for the rater, from 0
    Column("repeated", Integer, CheckConstraint("repeated in (0, 1)"), nullable=False),  # 1: asked again, the sides swapped
    Column("shown", JSON, nullable=False),  # the positions of the candidates, in the order in which they are shown
    Column("created", Float, nullable=False),
    # Nobody is asked twice, but for the one repetition that measures consistency.
    UniqueConstraint("item_id", "rater_id", "repeated"),
    Index("assignment_of_rater", "rater_id"),
)

judgement = Table(
    "judgement",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("assignment_id", ForeignKey("assignment.id"), nullable=False),
    Column("revision", Integer, nullable=False),
    Column("supersedes", ForeignKey("judgement.id"), unique=True),
    Column("verdict", Text, CheckConstraint(f"verdict in {(*VERDICTS, UNDONE)}"), nullable=False),
    Column("ranks", JSON(none_as_null=True)),  # by position, 0 the best, equal ones tie; null where nothing was said
    Column("strength", Integer),  # 1 slightly, 2 clearly, 3 much
    Column("reason", Text, nullable=False),
    Column("milliseconds", Integer),
    Column("client", Text, nullable=False),
    Column("request", Text, nullable=False, unique=True),  # the asker's own name for it: asking again adds nothing
    Column("created", Float, nullable=False),
    UniqueConstraint("assignment_id", "revision"),
)
