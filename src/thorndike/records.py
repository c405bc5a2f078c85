"""What a run's files say of it (``run.json``, ``policy.json``), checked field by field and without JAX, so that damage is told at once."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar, cast

from thorndike.algorithms import ALGORITHMS
from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.settings import check_value, find_setting
from thorndike.suggestions import did_you_mean
from thorndike.training.json_files import (
    FLAG,
    OBJECT,
    OBJECTS,
    TEXT,
    Json,
    Kind,
    blamed_on,
    check_fields,
    optional,
    parse_object,
    quoted,
    whole,
)
from thorndike.training.run_directory import read_run
from thorndike.training.sealed_folders import Damaged, SealedFolder

POLICY_FORMAT = 1

Content = TypeVar("Content")

_MOST = 10**9
_SHARED: Mapping[str, Kind] = {
    "algorithm": TEXT,
    "environment": TEXT,
    "environment_object": FLAG,
    "env_kwargs": OBJECT,
    "max_episode_steps": optional(whole(1)),
    "config": OBJECT,
    "network": TEXT,
    "wrappers": OBJECTS,
    "num_envs": whole(1, _MOST),
    "seeds": whole(1, _MOST),
}
_OF_RUN: Mapping[str, Kind] = {
    **_SHARED,
    "engine": TEXT,
    "preset": TEXT,
    "steps": whole(1),
    "seed": whole(0, 2**32 - 1),
    "log_every": whole(1),
    "checkpoint_every": whole(1),
    "device": TEXT,
    "processors": TEXT,
}
_LEARNT_FROM = Kind(
    "a path and a sha256",
    lambda value: isinstance(value, dict) and set(value) == {"path", "sha256"} and all(map(TEXT.admits, value.values())),
)
_OF_LATER: Mapping[str, Kind] = {
    "dataset": optional(_LEARNT_FROM),
    "start_from": optional(TEXT),
    "reward": optional(_LEARNT_FROM),
    "keep_checkpoints": optional(whole(2)),
}
_OF_POLICY: Mapping[str, Kind] = {**_SHARED, "observation_space": OBJECT, "action_space": OBJECT, "best": whole(0, _MOST)}


def read_record(run: Path) -> Json:
    """The content of ``run.json``, every field and setting checked. Raises ``UserError`` in one line."""
    record, where = read_run(run), run / "run.json"
    check_fields(record, {"algorithm": TEXT}, where)
    if record["algorithm"] == "planning":
        raise UserError(f"{run} is a plan: it is complete, there is nothing to go on with; `thorndike train planning` plans again")
    check_fields(record, _OF_RUN, where)
    # Runs of older versions do not have it.
    check_fields({"actors": record.get("actors")}, {"actors": optional(OBJECT)}, where)
    check_fields({name: record.get(name) for name in _OF_LATER}, _OF_LATER, where)
    _check_learner(record, where)
    return record


def read_policy_facts(folder: SealedFolder) -> Json:
    """The content of ``policy.json``, every field and setting checked. Raises ``UserError`` in one line."""
    where = folder.path / "policy.json"
    facts = parse_object(folder.read("policy.json"), where)
    if facts.get("format") != POLICY_FORMAT:
        raise UserError(f"{folder.path} has format {quoted(facts.get('format'))}; this version of thorndike reads format {POLICY_FORMAT}")
    check_fields(facts, _OF_POLICY, where)
    check_fields(facts, {"best": whole(0, cast(int, facts["seeds"]) - 1)}, where)
    _check_learner(facts, where)
    return facts


def from_policy(run: Path, read: Callable[[SealedFolder], Content]) -> Content:
    """What ``read`` makes of the policy of a run. Raises ``UserError`` in one line if there is none, or it is damaged."""
    folder = _policy_folder(run)
    while True:
        seen = os.stat(folder).st_ino
        try:
            return read(SealedFolder(folder))
        except Damaged as error:
            # A run that is training puts a new policy in the place of the one that is being read.
            replaced, folder = folder, _policy_folder(run)
            if folder == replaced and os.stat(folder).st_ino == seen:
                raise UserError(f"{error}; `thorndike resume {run}` writes the policy again from the last checkpoint") from None


def _policy_folder(run: Path) -> Path:
    # A process killed between the two renames of an export leaves the policy before it there.
    for folder in (run / "policy", run / "policy.old"):
        if folder.is_dir():
            return folder
    raise UserError(f"{run} has no trained policy: {'it has not reached its first checkpoint' if run.is_dir() else 'no such directory'}")


def _check_learner(facts: Json, where: Path) -> None:
    """The algorithm and every setting of it. Raises ``UserError``."""
    algorithm = cast(str, facts["algorithm"])
    if algorithm not in ALGORITHMS:
        raise UserError(f"there is no algorithm '{algorithm}'{did_you_mean(algorithm, ALGORITHMS)}")
    known = read_config_fields(algorithm)
    with blamed_on(where):
        for name, value in cast(Json, facts["config"]).items():
            check_value(_as_tuple(value), find_setting(name, known, algorithm), algorithm)


def _as_tuple(value: object) -> object:
    """Lists, which is what JSON makes of tuples, are tuples again."""
    return tuple(value) if isinstance(value, list) else value
