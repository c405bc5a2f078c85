"""A policy from the files of its run. They hold no code, and whatever they hold, the answer is a policy or one line."""

import os
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp

from thorndike.api.building import build_algorithm, check_algorithm, full_config
from thorndike.api.exporting import POLICY_FORMAT
from thorndike.environments.wrappers import from_settings
from thorndike.errors import UserError
from thorndike.networks.network import NetworkBuilder
from thorndike.training.json_files import FLAG, OBJECT, OBJECTS, TEXT, Json, blamed_on, check_fields, optional, parse_object, quoted, whole
from thorndike.training.policy import Policy
from thorndike.training.sealed_folders import Damaged, SealedFolder
from thorndike.training.space_files import space_from_json
from thorndike.training.tree_files import read_tree
from thorndike.types import Algorithm, EnvSpec, Wrapper

_MOST = 10**9
_FIELDS = {
    "algorithm": TEXT,
    "config": OBJECT,
    "network": TEXT,
    "environment": TEXT,
    "environment_object": FLAG,
    "env_kwargs": OBJECT,
    "max_episode_steps": optional(whole(1)),
    "num_envs": whole(1, _MOST),
    "wrappers": OBJECTS,
    "observation_space": OBJECT,
    "action_space": OBJECT,
    "seeds": whole(1, _MOST),
    "best": whole(0, _MOST),
}


def read_policy(run: Path, network: NetworkBuilder | None) -> tuple[Policy, Json]:
    """The policy of a run, and the content of its ``policy.json``. Raises ``UserError`` in one line if there is no intact one."""
    folder = _folder(run)
    while True:
        seen = os.stat(folder).st_ino
        try:
            return _read(SealedFolder(folder), run, network)
        except Damaged as error:
            # A run that is training puts a new policy in the place of the one that is being read.
            replaced, folder = folder, _folder(run)
            if folder == replaced and os.stat(folder).st_ino == seen:
                raise UserError(f"{error}; `thorndike resume {run}` writes the policy again from the last checkpoint") from None


def _folder(run: Path) -> Path:
    # A process killed between the two renames of an export leaves the policy before it there.
    for folder in (run / "policy", run / "policy.old"):
        if folder.is_dir():
            return folder
    raise UserError(f"{run} has no trained policy: {'it has not reached its first checkpoint' if run.is_dir() else 'no such directory'}")


def _read(folder: SealedFolder, run: Path, network: NetworkBuilder | None) -> tuple[Policy, Json]:
    where = folder.path / "policy.json"
    facts = parse_object(folder.read("policy.json"), where)
    if facts.get("format") != POLICY_FORMAT:
        raise UserError(f"{folder.path} has format {quoted(facts.get('format'))}; this version of thorndike reads format {POLICY_FORMAT}")
    check_fields(facts, _FIELDS, where)
    seeds, best = cast(int, facts["seeds"]), cast(int, facts["best"])
    check_fields(facts, {"best": whole(0, seeds - 1)}, where)
    if facts["network"] == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own: load it with td.load(run, network=...)")
    with blamed_on(where):
        algorithm, wrapper, spec = _parts(facts, network)
        like = _shapes(algorithm, wrapper, spec, seeds)
    stored = read_tree(like, folder, "policy")
    return Policy(algorithm, wrapper, spec, stored["actor"], stored["statistics"], best, run), facts


def _parts(facts: Json, network: NetworkBuilder | None) -> tuple[Algorithm, Wrapper, EnvSpec]:
    name, config = cast(str, facts["algorithm"]), cast(Json, facts["config"])
    check_algorithm(name)
    full_config(name, {key: tuple(value) if isinstance(value, list) else value for key, value in config.items()})
    wrapper = from_settings(cast(list[Json], facts["wrappers"]))
    observations, actions = (space_from_json(cast(Json, facts[part])) for part in ("observation_space", "action_space"))
    limit = cast(int | None, facts["max_episode_steps"])
    spec = EnvSpec(cast(str, facts["environment"]), observations, actions, num_envs=cast(int, facts["num_envs"]), max_episode_steps=limit)
    return build_algorithm(name, config, wrapper.spec(spec), network), wrapper, spec


def _shapes(algorithm: Algorithm, wrapper: Wrapper, spec: EnvSpec, seeds: int) -> dict:
    def one(key: jax.Array) -> dict:
        return {"actor": algorithm.actor(algorithm.init(key)), "statistics": wrapper.statistics(spec)}

    single = jax.eval_shape(one, jax.random.key(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((seeds, *jnp.shape(x)), x.dtype), single)
