"""Stores of preferences to test on: a SQLite file, and a PostgreSQL server of the tests' own where it is installed."""

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import uuid4

import pytest

PROGRAMS = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))


@pytest.fixture(scope="session")
def postgres() -> Iterator[str]:
    """The beginning of a URL: a server in a temporary folder that listens on a socket there only."""
    pytest.importorskip("psycopg", reason="psycopg is not installed: pip install 'thorndike[postgres]'")
    if not PROGRAMS:
        pytest.skip("no PostgreSQL server is installed: apt-get install postgresql")
    programs = PROGRAMS[-1].parent
    with tempfile.TemporaryDirectory(prefix="pg", dir="/tmp", ignore_cleanup_errors=True) as folder:
        account = _unprivileged()
        if account is not None:
            os.chown(folder, account.pw_uid, account.pw_gid)

        def run(*words: str) -> None:
            more = {} if account is None else {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
            subprocess.run(words, check=True, capture_output=True, cwd=folder, timeout=120, **more)

        data = f"{folder}/data"
        run(f"{programs}/initdb", "-D", data, "-A", "trust", "-U", "tester", "--no-sync", "-E", "UTF8", "--locale=C")
        settings = f"-k {folder} -c listen_addresses='' -c fsync=off -c shared_buffers=16MB -c max_connections=60"
        run(f"{programs}/pg_ctl", "-D", data, "-w", "-l", f"{folder}/log", "-o", settings, "start")
        try:
            yield f"{folder}"
        finally:
            run(f"{programs}/pg_ctl", "-D", data, "-w", "-m", "immediate", "stop")


def _unprivileged() -> pwd.struct_passwd | None:
    """PostgreSQL refuses to run as root."""
    if os.geteuid() != 0:
        return None
    names = {each.pw_name: each for each in pwd.getpwall()}
    return names.get("postgres") or names["nobody"]


@pytest.fixture(params=["sqlite", "postgresql"])
def new_store(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], str]:
    """Where a new, empty store may be made."""
    if request.param == "sqlite":
        return lambda: str(tmp_path / f"{uuid4().hex}.db")
    folder = request.getfixturevalue("postgres")

    def create() -> str:
        name = f"d{uuid4().hex}"
        program = shutil.which("createdb") or str(PROGRAMS[-1].with_name("createdb"))
        subprocess.run([program, "-h", folder, "-U", "tester", name], check=True, capture_output=True)
        return f"postgresql://tester@/{name}?host={folder}"

    return create
