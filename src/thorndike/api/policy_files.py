"""A policy from the files of its run. They hold no code, and whatever they hold, the answer is a policy or one line."""

from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp

from thorndike.algorithms import ALGORITHMS
from thorndike.api.building import build_algorithm
from thorndike.environments.wrappers import from_settings
from thorndike.errors import UserError
from thorndike.games.environment import observes_game
from thorndike.games.registry import game
from thorndike.networks.network import NetworkBuilder
from thorndike.records import from_policy, read_policy_facts
from thorndike.training.json_files import Json, blamed_on
from thorndike.training.policy import Policy
from thorndike.training.sealed_folders import SealedFolder
from thorndike.training.space_files import space_from_json
from thorndike.training.tree_files import read_tree
from thorndike.types import Algorithm, EnvSpec, Wrapper


def read_policy(run: Path, network: NetworkBuilder | None) -> tuple[Policy, Json]:
    """The policy of a run, and the content of its ``policy.json``. Raises ``UserError`` in one line if there is no intact one."""
    return from_policy(run, lambda folder: _read(folder, run, network))


def _read(folder: SealedFolder, run: Path, network: NetworkBuilder | None) -> tuple[Policy, Json]:
    where = folder.path / "policy.json"
    facts = read_policy_facts(folder)
    seeds, best = cast(int, facts["seeds"]), cast(int, facts["best"])
    if facts["network"] == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own: load it with td.load(run, network=...)")
    with blamed_on(where):
        algorithm, wrapper, spec = _parts(facts, network)
        like = _shapes(algorithm, wrapper, spec, seeds)
    stored = read_tree(like, folder, "policy")
    return Policy(algorithm, wrapper, spec, stored["actor"], stored["statistics"], best, run), facts


def _parts(facts: Json, network: NetworkBuilder | None) -> tuple[Algorithm, Wrapper, EnvSpec]:
    name, config = cast(str, facts["algorithm"]), cast(Json, facts["config"])
    wrapper = from_settings(cast(list[Json], facts["wrappers"]))
    observations, actions = (space_from_json(cast(Json, facts[part])) for part in ("observation_space", "action_space"))
    limit = cast(int | None, facts["max_episode_steps"])
    environment, num_envs = cast(str, facts["environment"]), cast(int, facts["num_envs"])
    rules = game(environment) if ALGORITHMS[name].searches and observes_game(observations) else None
    spec = EnvSpec(environment, observations, actions, num_envs=num_envs, max_episode_steps=limit, game=rules)
    return build_algorithm(name, config, wrapper.spec(spec), network), wrapper, spec


def _shapes(algorithm: Algorithm, wrapper: Wrapper, spec: EnvSpec, seeds: int) -> dict:
    def one(key: jax.Array) -> dict:
        return {"actor": algorithm.actor(algorithm.init(key)), "statistics": wrapper.statistics(spec)}

    single = jax.eval_shape(one, jax.random.key(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((seeds, *jnp.shape(x)), x.dtype), single)
