"""Learnt rewards as folders: the ensemble's arrays, and what they are of. They hold no code."""

import hashlib
from pathlib import Path
from typing import NamedTuple, cast

import gymnasium
import jax

from thorndike.clips.folder import FACTS, REWARDS, numbered
from thorndike.clips.reward_fitting import Report
from thorndike.environments.learned_reward import LearnedReward, no_reward
from thorndike.errors import UserError
from thorndike.training.json_files import OBJECT, TEXT, Json, Kind, as_bytes, blamed_on, check_fields, parse_object, whole
from thorndike.training.sealed_folders import MANIFEST, NewFolder, SealedFolder
from thorndike.training.space_files import space_from_json, space_to_json
from thorndike.training.tree_files import read_tree, write_tree

_FACTS, _ARRAYS = "reward.json", "reward"
_WIDTHS = Kind("a list of widths", lambda value: isinstance(value, list) and all(type(each) is int and each > 0 for each in value))
_KINDS = {"environment": TEXT, "observation_space": OBJECT, "action_space": OBJECT, "members": whole(1, 1000), "net_arch": _WIDTHS}


class StoredReward(NamedTuple):
    """A reward that was learnt, and where it lies; its arrays are read by ``load_reward``."""

    path: Path
    sha256: str
    """Of its manifest, which names the hash of every file."""
    environment: str
    spaces: tuple[gymnasium.Space, gymnasium.Space]
    members: int
    net_arch: tuple[int, ...]


def write_reward(where: Path, held: LearnedReward, net_arch: tuple[int, ...], environment: str, spaces: tuple, report: Report) -> Path:
    """The next reward of a folder of clips."""
    rewards = where / REWARDS
    known = numbered(rewards)
    path = rewards / str(int(known[-1].name) + 1 if known else 0)
    observation_space, action_space = map(space_to_json, spaces)
    facts: Json = {"environment": environment, "observation_space": observation_space, "action_space": action_space}
    facts |= {"members": int(held.params.shape[0]), "net_arch": list(net_arch), "report": report._asdict()}
    new = NewFolder(rewards / "partial")
    write_tree(held, new, _ARRAYS)
    new.write(_FACTS, as_bytes(facts))
    new.publish(path)
    return path


def newest_reward(where: Path) -> Path | None:
    """The reward that was learnt last in a folder of clips; None if there is none yet."""
    known = numbered(where / REWARDS)
    return known[-1] if known else None


def read_reward(where: str | Path) -> StoredReward:
    """What is known of a reward, or of the newest one of a folder of clips; JAX is not started for it.

    Raises ``UserError`` if there is none, or it is not as it was written.
    """
    path: Path | None = Path(where)
    if (Path(where) / FACTS).exists():
        path = newest_reward(Path(where))
        if path is None:
            raise UserError(f"no reward has been learnt in {where} yet: judge some pairs, then thorndike clips fit {where}")
    if path is None or not (path / _FACTS).exists():
        raise UserError(f"{where} holds no learnt reward: give a folder of clips in which thorndike clips fit has made one")
    sealed = SealedFolder(path)
    facts = parse_object(sealed.read(_FACTS), path / _FACTS)
    check_fields(facts, _KINDS, path / _FACTS)
    with blamed_on(path / _FACTS):
        observation_space, action_space = (space_from_json(cast(Json, facts[name])) for name in ("observation_space", "action_space"))
    hidden = tuple(cast(list[int], facts["net_arch"]))
    digest = hashlib.sha256((path / MANIFEST).read_bytes()).hexdigest()
    spaces = observation_space, action_space
    return StoredReward(path.absolute(), digest, cast(str, facts["environment"]), spaces, cast(int, facts["members"]), hidden)


def load_reward(stored: StoredReward) -> LearnedReward:
    """Its arrays. Raises ``UserError`` if they are not as they were written."""
    like = jax.eval_shape(lambda: no_reward(stored.spaces, stored.members, stored.net_arch))
    held: LearnedReward = read_tree(like, SealedFolder(stored.path), _ARRAYS)
    return held
