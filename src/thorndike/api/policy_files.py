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
from thorndike.records import from_policy, read_policy_facts, read_record
from thorndike.training.checkpoints import read_actors
from thorndike.training.json_files import Json, blamed_on
from thorndike.training.policy import Policy
from thorndike.training.run_directory import checkpoint_of
from thorndike.training.sealed_folders import SealedFolder
from thorndike.training.space_files import space_from_json
from thorndike.training.tree_files import read_tree
from thorndike.types import Algorithm, EnvSpec, Wrapper


def read_policy(run: Path, network: NetworkBuilder | None, step: int | None = None) -> tuple[Policy, Json]:
    """The policy of a run, or of its checkpoint at ``step``, and the content of its ``policy.json``.

    Raises ``UserError`` in one line if there is no intact one.
    """
    if step is None:
        return from_policy(run, lambda folder: _read(folder, run, network))
    return _read_checkpoint(run, network, checkpoint_of(run, step))


def _read(folder: SealedFolder, run: Path, network: NetworkBuilder | None) -> tuple[Policy, Json]:
    facts = read_policy_facts(folder)
    _need_network(run, facts, network)
    with blamed_on(folder.path / "policy.json"):
        algorithm, wrapper, spec = _parts(facts, network)
        like = _shapes(algorithm, wrapper, spec, cast(int, facts["seeds"]))
    stored = read_tree(like, folder, "policy")
    return Policy(algorithm, wrapper, spec, stored["actor"], stored["statistics"], cast(int, facts["best"]), run), facts


def _read_checkpoint(run: Path, network: NetworkBuilder | None, folder: Path) -> tuple[Policy, Json]:
    """What acts there, with the newest policy's description: the same learner, and the seed that is the best now."""
    facts, record = from_policy(run, read_policy_facts), read_record(run)
    _need_network(run, facts, network)
    with blamed_on(run / "policy" / "policy.json"):
        algorithm, wrapper, spec = _parts(facts, network)
        statistics = jax.eval_shape(lambda: wrapper.statistics(spec))
        # Those that hold a function of the user's stand in the chain, and are not exported.
        places = [place for place, settings in enumerate(cast(list[Json], record["wrappers"])) if settings]
        by_place = dict(zip(places, statistics, strict=True))
    compiled = record["engine"] == "native"
    actors, learnt = read_actors(folder, algorithm, by_place, cast(int, facts["seeds"]), compiled)
    return Policy(algorithm, wrapper, spec, actors, learnt, cast(int, facts["best"]), run), facts


def _need_network(run: Path, facts: Json, network: NetworkBuilder | None) -> None:
    if facts["network"] == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own: load it with td.load(run, network=...)")


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
