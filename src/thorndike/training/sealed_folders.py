"""Folders that are there as a whole or not at all, and that tell when they were damaged.

A folder is written aside, every file flushed to the disk, sealed by ``manifest.json`` (size and sha256 of each file), flushed, and renamed
into place. Whatever is read from it afterwards is compared with the manifest first.
"""

import errno
import hashlib
import os
import shutil
import stat
from pathlib import Path
from typing import NamedTuple, TypeAlias

from thorndike.errors import UserError
from thorndike.training.json_files import Json, as_bytes, parse_object
from thorndike.training.notices import notice

MANIFEST = "manifest.json"
_FORMAT = 2
_NO_LINKS = (errno.EPERM, errno.EACCES, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EXDEV, errno.EMLINK)
"""A file cannot have a second name: not here, not across file systems, not one more, or not by this user."""

Bytes: TypeAlias = bytes | memoryview


class Damaged(UserError):
    """A folder is not what was written. The message is one line that names it."""


class Seal(NamedTuple):
    """What a manifest says of a file."""

    bytes: int | None
    """None in manifests of format 1, which had hashes only."""
    sha256: str


class NewFolder:
    """A folder being written aside; it is nowhere to be seen until ``publish``."""

    def __init__(self, aside: Path) -> None:
        """Make the folder `aside`; what a process that died left there goes first."""
        _remove(aside)
        os.mkdir(aside)
        self.path = aside
        self._seals: dict[str, Seal] = {}

    def write(self, name: str, data: Bytes) -> None:
        """Write a file and flush it to the disk."""
        write_durably(self.path / name, data)
        self._seals[name] = _seal_of(data)

    def share(self, data: Bytes, suffix: str, donor: Path | None) -> str:
        """Have a file that is named after its hash, and return the name.

        Where the folder has it already nothing is done; where the folder `donor` has it, it gets a second name and nothing is written.
        """
        seal = _seal_of(data)
        name = seal.sha256 + suffix
        if name in self._seals:
            return name
        if donor is None or not _holds(donor / name, data) or not _linked(donor / name, self.path / name):
            write_durably(self.path / name, data)
        self._seals[name] = seal
        return name

    def publish(self, final: Path) -> None:
        """Seal the folder and rename it into place. A folder that is there already is kept, under another name, until the new one is."""
        files = {name: seal._asdict() for name, seal in sorted(self._seals.items())}
        write_durably(self.path / MANIFEST, as_bytes({"format": _FORMAT, "files": files}))
        flush(self.path)
        old = final.with_name(final.name + ".old")
        if final.exists():
            _remove(old)
            os.rename(final, old)
        os.rename(self.path, final)
        flush(final.parent)
        discard(old)


class SealedFolder:
    """A published folder. Its files are read whole and compared with the manifest; nothing unproven is handed out."""

    def __init__(self, folder: Path) -> None:
        """Read the manifest. Raises ``Damaged`` if it is not as it was written, or files are missing or too many."""
        self.path = folder
        self._seals = _seals_in(self._bytes(MANIFEST, None), folder)
        found = set(self._listed()) - {MANIFEST}
        for name in sorted(found ^ set(self._seals)):
            raise Damaged(f"{folder} is damaged: {name!r} {'is no part of it' if name in found else 'is missing'}")

    def __contains__(self, name: str) -> bool:
        return name in self._seals

    @property
    def names(self) -> list[str]:
        """Its files, the manifest left out."""
        return sorted(self._seals)

    def read(self, name: str) -> bytes:
        """A file's content. Raises ``Damaged`` if it is not what was written."""
        if name not in self._seals:
            raise Damaged(f"{self.path} is damaged: {name!r} is missing")
        seal = self._seals[name]
        data = self._bytes(name, seal.bytes)
        if hashlib.sha256(data).hexdigest() != seal.sha256:
            raise Damaged(f"{self.path} is damaged: {name!r} is not what was written")
        return data

    def _bytes(self, name: str, size: int | None) -> bytes:
        path = self.path / name
        try:
            facts = os.lstat(path)
            # Looked at before it is opened: a link may lead anywhere, and some files never end.
            if not stat.S_ISREG(facts.st_mode) or size not in (None, facts.st_size):
                raise Damaged(f"{self.path} is damaged: {name!r} is not what was written")
            return path.read_bytes()
        except FileNotFoundError:
            raise Damaged(f"{self.path} is damaged: {name!r} is missing") from None
        except OSError as error:
            raise Damaged(f"{self.path} cannot be read: {name!r}: {error.strerror}") from error

    def _listed(self) -> list[str]:
        try:
            return os.listdir(self.path)
        except OSError as error:
            raise Damaged(f"{self.path} cannot be read: {error.strerror}") from error


def intact(folder: Path) -> bool:
    """Whether a folder is sealed and every file in it is as it was written."""
    try:
        sealed = SealedFolder(folder)
        for name in sealed.names:
            sealed.read(name)
    except Damaged:
        return False
    return True


def write_durably(path: Path, data: Bytes) -> None:
    """Write a new file and flush it to the disk."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        write_all(descriptor, data)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_all(descriptor: int, data: Bytes) -> None:
    """Write all of it: a single call may write less."""
    rest = memoryview(data)
    while rest.nbytes:
        rest = rest[os.write(descriptor, rest) :]


def flush(path: Path) -> None:
    """Make durable what was written to a file, or what was made, linked or renamed in a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def discard(folder: Path) -> None:
    """Remove a folder that is not needed any more. It is renamed first, so that half of it is never taken for the whole."""
    try:
        if folder.exists():
            going = folder.with_name(folder.name.removesuffix(".gone") + ".gone")
            if going != folder:
                _remove(going)
                os.rename(folder, going)
            _remove(going)
    except OSError as error:
        notice(f"{folder} is not needed any more but could not be removed: {error.strerror}; it only takes space")


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)


def _linked(old: Path, new: Path) -> bool:
    """Whether a file could be given a second name. Raises ``OSError`` for what would keep it from being written too."""
    try:
        os.link(old, new)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        return False
    return True


def _seal_of(data: Bytes) -> Seal:
    return Seal(len(data), hashlib.sha256(data).hexdigest())


def _holds(path: Path, data: Bytes) -> bool:
    """Whether a file holds these bytes; it may have been damaged since it was written."""
    try:
        return path.stat().st_size == len(data) and path.read_bytes() == data
    except OSError:
        return False


def _seals_in(text: bytes, folder: Path) -> dict[str, Seal]:
    """What a manifest says. Raises ``Damaged``."""
    try:
        content = parse_object(text, folder / MANIFEST)
    except UserError as error:
        raise Damaged(str(error)) from None
    # What was written has one form only, so that even a change that means nothing is found.
    seals = _read_seals(content) if as_bytes(content) == text else None
    if seals is not None:
        return seals
    known = content.get("format")
    if type(known) is int and known != _FORMAT:
        raise Damaged(f"{folder} has format {known}; this version of thorndike reads format {_FORMAT}")
    raise Damaged(f"{folder} is damaged: its manifest is not what was written")


def _read_seals(content: Json) -> dict[str, Seal] | None:
    """The files of a manifest, or None if it is none. Format 1 was ``{"sha256": {name: hash}}``."""
    match content:
        case {"format": 2, "files": dict(files)} if len(content) == 2:
            seals = {name: _read_seal(facts) for name, facts in files.items()}
        case {"sha256": dict(hashes)} if len(content) == 1:
            seals = {name: _read_seal({"bytes": None, "sha256": digest}) for name, digest in hashes.items()}
        case _:
            return None
    known = {name: seal for name, seal in seals.items() if seal is not None}
    return known if len(known) == len(seals) else None


def _read_seal(facts: object) -> Seal | None:
    match facts:
        case {"bytes": int() | None as size, "sha256": str(digest), **more} if not more:
            return Seal(size, digest)
    return None
