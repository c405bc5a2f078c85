"""A folder of clips: what was recorded, the store of choices, and the rewards that were learnt from them.

``clips.json`` (of which environment, how long a clip is), ``collections/<n>`` (arrays, which pairs are asked, who acted), ``films/*.mp4``,
``choices.db`` (a preference store) and ``rewards/<n>``. What is there is never written over.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import gymnasium

from thorndike.clips.segments import Segments, together
from thorndike.errors import UserError
from thorndike.training.json_files import OBJECT, TEXT, Json, as_bytes, check_fields, optional, parse_object, quoted, read_object, whole
from thorndike.training.run_directory import write_json
from thorndike.training.sealed_folders import NewFolder, SealedFolder
from thorndike.training.space_files import space_from_json
from thorndike.training.tree_files import read_arrays, write_tree

FACTS, FILMS, REWARDS = "clips.json", "films", "rewards"
_COLLECTIONS, _ABOUT = "collections", "about.json"
_KINDS = {
    "environment": TEXT,
    "env_kwargs": OBJECT,
    "max_episode_steps": optional(whole(1)),
    "observation_space": OBJECT,
    "action_space": OBJECT,
    "length": whole(1, 100_000),
    "question": TEXT,
}


class About(NamedTuple):
    """What a folder's clips are of; ``clips.json``."""

    environment: str
    env_kwargs: dict[str, object]
    max_episode_steps: int | None
    observation_space: Json
    """As ``space_files`` has it."""
    action_space: Json
    length: int
    """Steps of a clip."""
    question: str
    """What raters are asked."""

    @property
    def spaces(self) -> tuple[gymnasium.Space, gymnasium.Space]:
        """Of observations and actions."""
        return space_from_json(self.observation_space), space_from_json(self.action_space)


class Collection(NamedTuple):
    """Clips that were recorded together."""

    number: int
    segments: Segments
    pairs: list[tuple[int, int]]
    """Which of them are compared."""
    made_by: str
    filmed: bool


def begin_folder(where: Path, about: About) -> None:
    """Make a folder of clips, or find it there. Raises ``UserError`` if it is of something else."""
    if (where / FACTS).exists():
        there = read_about(where)
        for name, old, new in zip(About._fields, there, about, strict=True):
            if old != new:
                raise UserError(f"{where} was begun with {name} = {quoted(old)}, not {quoted(new)}: give that, or choose another folder")
        return
    if where.exists() and (not where.is_dir() or any(where.iterdir())):
        raise UserError(f"{where} is there already and is no folder of clips: choose another")
    try:
        for name in (_COLLECTIONS, FILMS, REWARDS):
            (where / name).mkdir(parents=True, exist_ok=True)
        write_json(where / FACTS, about._asdict())
    except OSError as error:
        raise UserError(f"{where} cannot be written: {error.strerror}; choose another folder") from error


def read_about(where: Path) -> About:
    """What the clips in a folder are of. Raises ``UserError`` if there are none."""
    try:
        content = read_object(where / FACTS)
    except FileNotFoundError:
        raise UserError(
            f"{where} is no folder of clips: it has no {FACTS}; make one: thorndike clips collect ENVIRONMENT --to DIR"
        ) from None
    check_fields(content, _KINDS, where / FACTS)
    make: Callable[..., About] = About
    return make(*(content[name] for name in About._fields))


def numbered(folder: Path) -> list[Path]:
    """The folders that are called by a number, in its order."""
    return sorted((path for path in folder.glob("*") if path.name.isdecimal()), key=lambda path: int(path.name))


def add_collection(where: Path, collection: Collection) -> None:
    """Write a collection. Given again, what is there already is left as it is."""
    folder = where / _COLLECTIONS / str(collection.number)
    if not folder.exists():
        new = NewFolder(where / _COLLECTIONS / "partial")
        write_tree(collection.segments._asdict(), new, "segments")
        about: Json = {"pairs": collection.pairs, "made_by": collection.made_by, "filmed": collection.filmed}
        new.write(_ABOUT, as_bytes(about))
        new.publish(folder)


def collections(where: Path) -> list[Collection]:
    """Everything that was recorded, in order. Raises ``UserError`` for what is damaged."""
    return [_read_collection(path) for path in numbered(where / _COLLECTIONS)]


def number_of_collections(where: Path) -> int:
    """How many there are."""
    return len(numbered(where / _COLLECTIONS))


def all_segments(where: Path) -> Segments:
    """All clips. Raises ``UserError`` if nothing was recorded yet."""
    found = collections(where)
    if not found:
        raise UserError(f"nothing has been recorded in {where} yet: thorndike clips collect")
    return together([each.segments for each in found])


def clip_name(collection: int, place: int) -> str:
    """What a clip is called, and its film without the ending."""
    return f"{collection}-{place}"


def _read_collection(folder: Path) -> Collection:
    sealed = SealedFolder(folder)
    arrays, about = read_arrays(sealed, "segments"), parse_object(sealed.read(_ABOUT), folder / _ABOUT)
    leaves = sorted((name for name in arrays if name.startswith("obs/")), key=lambda name: int(name.partition("/")[2]))
    segments = Segments(tuple(arrays[name] for name in leaves), arrays["action"], arrays["reward"], arrays["valid"])
    pairs = [(int(first), int(second)) for first, second in cast(list[list[int]], about["pairs"])]
    return Collection(int(folder.name), segments, pairs, str(about["made_by"]), bool(about["filmed"]))
