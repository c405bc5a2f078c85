"""``load``: a trained policy from its run directory, to act with, evaluate and watch."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp

from thorndike.api.building import EnvironmentLike, build_algorithm
from thorndike.api.exporting import POLICY_FORMAT
from thorndike.environments import registry
from thorndike.environments.host.action_masks import mask_in_observation
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.origins import limit_of
from thorndike.environments.wrappers import from_settings
from thorndike.errors import UserError
from thorndike.networks.masking import has_mask
from thorndike.training.evaluation import Evaluation, evaluate
from thorndike.training.policy import Policy
from thorndike.training.run_directory import append_lines, intact
from thorndike.training.space_files import space_from_json
from thorndike.training.tree_files import load_tree
from thorndike.training.video import film
from thorndike.types import Algorithm, Environment, EnvSpec, Wrapper

LONGEST_EPISODE = 10_000
"""Steps after which evaluation cuts an episode of an environment that has no time limit of its own."""


class LoadedPolicy:
    """A trained policy with the environment it was trained on. With several seeds it acts as the best; ``seeds[i]`` is any other."""

    def __init__(self, policy: Policy, facts: dict, environment: EnvironmentLike | None) -> None:
        """``facts`` is the content of policy.json; ``environment`` the object trained on, if it was no id."""
        self._policy = policy
        self.facts = facts
        self._environment = environment
        self.predict = policy.predict
        self.value = policy.value

    @property
    def run(self) -> Path | None:
        """The run's directory."""
        return self._policy.run

    @property
    def seeds(self) -> Sequence["LoadedPolicy"]:
        """Each agent as a policy of its own."""
        return [LoadedPolicy(policy, self.facts, self._environment) for policy in self._policy.seeds]

    def evaluate(self, episodes: int = 100, seed: int = 0, num_envs: int | None = None, deterministic: bool = True) -> Evaluation:
        """Run every seed on fresh reference environments; the episodes are appended to the run's evaluations.jsonl.

        An environment without a time limit gets one of ``LONGEST_EPISODE`` steps.
        """
        choice = self._choice()
        make, limit = self._maker(choice), choice.max_episode_steps

        def build(number: int) -> LoopEngine:
            return LoopEngine([make] * number, choice.id, limit)

        found = evaluate(self._policy, build, episodes, seed, num_envs or 20, deterministic)
        if self.run is not None:
            settings = {"evaluation_seed": seed, "deterministic": deterministic}
            names = {"total": "return"}
            rows = [{names.get(key, key): value for key, value in row._asdict().items()} for row in found.rows]
            append_lines(self.run / "evaluations.jsonl", [settings | row for row in rows])
        return found

    def watch(self, path: str | Path | None = None, episodes: int = 1, seed: int = 0) -> Path | None:
        """Film episodes of the policy as mp4, or show them in a window if no path is given."""
        choice = self._choice()
        return film(self._policy, self._maker(choice), None if path is None else Path(path), episodes, seed)

    def _maker(self, choice: registry.Choice) -> Callable[..., gymnasium.Env]:
        make = partial(registry.reference, choice)
        return mask_in_observation(make) if has_mask(self._policy.spec.observation_space) else make

    def _choice(self) -> registry.Choice:
        if self._environment is None and self.facts["environment_object"]:
            raise UserError(f"{self.run} was trained on an environment object: load it with td.load(run, environment=...)")
        named: EnvironmentLike = self.facts["environment"] if self._environment is None else self._environment
        choice = registry.resolve(named, env_kwargs=self.facts["env_kwargs"], max_episode_steps=self.facts["max_episode_steps"])
        if choice.max_episode_steps is not None or isinstance(choice.origin, gymnasium.vector.VectorEnv | Environment):
            return choice
        probe = registry.reference(choice)
        limit = limit_of(probe)
        probe.close()
        # A greedy policy that walks in circles would never end an episode of an environment without a limit.
        return choice if limit is not None else choice._replace(max_episode_steps=LONGEST_EPISODE)


def load(run: str | Path, *, environment: EnvironmentLike | None = None, network: Callable | None = None) -> LoadedPolicy:
    """The trained policy of a run.

    ``environment`` and ``network`` are needed again where they were Python objects. Raises ``UserError`` if the run has no intact policy
    yet.
    """
    run = Path(run)
    folder = run / "policy"
    if not folder.is_dir() and (run / "policy.old").is_dir():
        # A process killed between the two renames of an export leaves the policy before it there.
        folder = run / "policy.old"
    if not folder.is_dir():
        raise UserError(
            f"{run} has no trained policy: {'it has not reached its first checkpoint' if run.is_dir() else 'no such directory'}"
        )
    if not intact(folder):
        raise UserError(f"the policy in {folder} is damaged: a file is not what its manifest says; resume the run to write it again")
    facts = json.loads((folder / "policy.json").read_text(encoding="utf-8"))
    if facts.get("format") != POLICY_FORMAT:
        raise UserError(f"{folder} has format {facts.get('format')!r}; this version of thorndike reads format {POLICY_FORMAT}")
    if facts["network"] == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own: load it with td.load(run, network=...)")
    wrapper = from_settings(facts["wrappers"])
    observations, actions = space_from_json(facts["observation_space"]), space_from_json(facts["action_space"])
    spec = EnvSpec(facts["environment"], observations, actions, num_envs=facts["num_envs"], max_episode_steps=facts["max_episode_steps"])
    algorithm = build_algorithm(facts["algorithm"], facts["config"], wrapper.spec(spec), network)
    stored = load_tree(_shapes(algorithm, wrapper, spec, facts["seeds"]), folder / "policy.safetensors")
    policy = Policy(algorithm, wrapper, spec, stored["actor"], stored["statistics"], facts["best"], run)
    return LoadedPolicy(policy, facts, environment)


def evaluate_run(run: str | Path, episodes: int = 100, seed: int = 0, deterministic: bool = True) -> Evaluation:
    """Evaluate every seed of a run on fresh reference environments: ``load(run).evaluate(...)``."""
    return load(run).evaluate(episodes, seed, deterministic=deterministic)


def _shapes(algorithm: Algorithm, wrapper: Wrapper, spec: EnvSpec, seeds: int) -> dict:
    def one(key: jax.Array) -> dict:
        return {"actor": algorithm.actor(algorithm.init(key)), "statistics": wrapper.statistics(spec)}

    single = jax.eval_shape(one, jax.random.key(0))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((seeds, *jnp.shape(x)), x.dtype), single)
