"""Connections to a preference store: SQLite with a write-ahead log, or another database by URL."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from sqlalchemy import URL, Connection, Engine, create_engine, event, insert, make_url, select
from sqlalchemy.exc import ArgumentError, DatabaseError, IntegrityError, OperationalError

from thorndike.errors import UserError
from thorndike.language.preferences import schema

_BUSY_S = 30
"""How long a writer waits for the one before it."""


class Database:
    """An engine with one kind of transaction for reading and one for writing."""

    def __init__(self, where: str | Path) -> None:
        """Connect, and make the tables where there are none. Raises ``UserError`` for what is no store, or one of a newer version."""
        url = _url(where)
        self.name = url.render_as_string(hide_password=True) if url.get_backend_name() != "sqlite" else str(url.database)
        self._engine = create_engine(url, pool_pre_ping=url.get_backend_name() != "sqlite")
        if url.get_backend_name() == "sqlite":
            _prepare_sqlite(self._engine)
        self._writer = self._engine.execution_options(writes=True)
        try:
            self._make_tables()
        except (OperationalError, DatabaseError) as error:
            reason = " ".join(str(error.orig).split())[:200]
            raise UserError(f"{self.name} cannot be opened as a store of preferences: {reason}") from error

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that changes nothing: it sees one state of the store, and waits for nobody."""
        with self._engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """A transaction that is on the disk when the block is left, or has never been."""
        with self._writer.connect() as connection, connection.begin():
            yield connection

    def close(self) -> None:
        """Give all connections back."""
        self._engine.dispose()

    def _make_tables(self) -> None:
        table = schema.store_version
        try:
            with self.writing() as connection:
                schema.METADATA.create_all(connection)
                version = connection.execute(select(table.c.version)).scalar()
                if version is None:
                    connection.execute(insert(table).values(version=schema.VERSION))
        except IntegrityError:
            # Two made the tables at the same time: the other one was first.
            return self._make_tables()
        if version is not None and version != schema.VERSION:
            raise UserError(
                f"{self.name} is a store of version {version}, this Thorndike reads version {schema.VERSION}: install a newer one"
            )


def _url(where: str | Path) -> URL:
    text = str(where)
    if "://" not in text:
        folder = Path(text).parent
        if not folder.is_dir():
            raise UserError(f"there is no folder {folder} for the store {text}: make it first")
        return URL.create("sqlite", database=text)
    try:
        url = make_url(text)
        backend = url.get_backend_name()
    except ArgumentError as error:
        raise UserError(f"'{text}' is no address of a database; expected a file's path, or postgresql://USER@HOST/NAME") from error
    if backend == "postgresql":
        if find_spec("psycopg") is None:
            raise UserError("PostgreSQL needs psycopg, which is not installed: pip install 'thorndike[postgres]'")
        return url.set(drivername="postgresql+psycopg")
    if backend != "sqlite":
        raise UserError(
            f"stores are kept in SQLite or PostgreSQL, not in '{backend}'; expected a file's path, or postgresql://USER@HOST/NAME"
        )
    return url


def _prepare_sqlite(engine: Engine) -> None:
    @event.listens_for(engine, "connect")
    def connected(connection: sqlite3.Connection, record: object) -> None:
        # The driver would begin transactions on its own, as late as the first write: too late to wait for another writer.
        connection.isolation_level = None
        for pragma in (f"busy_timeout={_BUSY_S * 1000}", "journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def began(connection: Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE" if connection.get_execution_options().get("writes") else "BEGIN")
