"""``load``: a trained policy from its run directory, to act with, evaluate and watch."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import cast

import gymnasium

from thorndike.api.building import EnvironmentLike
from thorndike.api.policy_files import read_policy
from thorndike.api.recorded_run import refuse_code
from thorndike.api.value_scale import incomparable_values
from thorndike.environments import registry
from thorndike.environments.host.action_masks import mask_in_observation
from thorndike.environments.host.atari import described
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.origins import limit_of
from thorndike.errors import UserError
from thorndike.networks.masking import has_mask
from thorndike.training.evaluation import Evaluation, evaluate
from thorndike.training.policy import Policy
from thorndike.training.run_directory import append_lines
from thorndike.training.video import film
from thorndike.types import Environment

LONGEST_EPISODE = 10_000
"""Steps after which evaluation cuts an episode of an environment that has no time limit of its own."""


class LoadedPolicy:
    """A trained policy with the environment it was trained on. With several seeds it acts as the best; ``seeds[i]`` is any other."""

    def __init__(self, policy: Policy, facts: dict, environment: EnvironmentLike | None, checkpoint: int | None = None) -> None:
        """``facts`` is the content of policy.json; ``environment`` the object trained on, if it was no id; ``checkpoint`` its step, if it
        is one.
        """
        self._policy = policy
        self.checkpoint = checkpoint
        self.facts = facts
        self._environment = environment
        self.predict = policy.predict
        self.value = policy.value

    @property
    def run(self) -> Path | None:
        """The run's directory."""
        return self._policy.run

    @property
    def protocol(self) -> str | None:
        """Of an Atari game: what it is trained and evaluated by, in words."""
        return described(self.facts["environment"], self.facts["env_kwargs"])

    @property
    def policy(self) -> Policy:
        """The policy by itself, without its environment."""
        return self._policy

    @property
    def seeds(self) -> Sequence["LoadedPolicy"]:
        """Each agent as a policy of its own."""
        return [LoadedPolicy(policy, self.facts, self._environment, self.checkpoint) for policy in self._policy.seeds]

    def evaluate(self, episodes: int = 100, seed: int = 0, num_envs: int | None = None, deterministic: bool = True) -> Evaluation:
        """Run every seed on fresh reference environments; the episodes are appended to the run's evaluations.jsonl, but for a checkpoint's.

        An environment without a time limit gets one of ``LONGEST_EPISODE`` steps.
        """
        build = reference_engines(self.choice(), self._policy.spec.observation_space)
        gamma = None if self.incomparable_values is not None else cast(float, self.facts["config"]["gamma"])
        found = evaluate(self._policy, build, episodes, seed, num_envs or 20, deterministic, gamma)
        if self.run is not None and self.checkpoint is None:
            settings = {"evaluation_seed": seed, "deterministic": deterministic}
            names = {"total": "return", "discounted": "discounted_return"}
            rows = [{names.get(key, key): value for key, value in row._asdict().items()} for row in found.rows]
            append_lines(self.run / "evaluations.jsonl", [settings | row for row in rows])
        return found

    @property
    def incomparable_values(self) -> str | None:
        """Why the learner's values cannot be held against the environment's rewards; None where they can."""
        return incomparable_values(self.facts)

    def watch(self, path: str | Path | None = None, episodes: int = 1, seed: int = 0) -> Path | None:
        """Film episodes of the policy as mp4, or show them in a window if no path is given."""
        choice = self.choice()
        return film(self._policy, _maker(choice, self._policy.spec.observation_space), None if path is None else Path(path), episodes, seed)

    def choice(self) -> registry.Choice:
        """The environment that the policy is evaluated on. Raises ``UserError`` if it is an object that was not given."""
        if self._environment is None and self.facts["environment_object"]:
            raise UserError(f"{self.run} was trained on an environment object: load it with td.load(run, environment=...)")
        if self._environment is None and self.run is not None:
            refuse_code(self.run, self.facts["environment"])
        named: EnvironmentLike = self.facts["environment"] if self._environment is None else self._environment
        return bounded(registry.resolve(named, env_kwargs=self.facts["env_kwargs"], max_episode_steps=self.facts["max_episode_steps"]))


def bounded(choice: registry.Choice) -> registry.Choice:
    """The same environment, with a limit of ``LONGEST_EPISODE`` steps if it has none of its own."""
    if choice.max_episode_steps is not None or isinstance(choice.origin, gymnasium.vector.VectorEnv | Environment):
        return choice
    probe = registry.reference(choice)
    limit = limit_of(probe)
    probe.close()
    # A greedy policy that walks in circles would never end an episode of an environment without a limit.
    return choice if limit is not None else choice._replace(max_episode_steps=LONGEST_EPISODE)


def reference_engines(choice: registry.Choice, space: gymnasium.Space) -> Callable[[int], LoopEngine]:
    """Number -> that many reference environments to evaluate on; ``space`` is what the trained policy observed."""
    make = _maker(choice, space)
    return lambda number: LoopEngine([make] * number, choice.id, choice.max_episode_steps)


def _maker(choice: registry.Choice, space: gymnasium.Space) -> Callable[..., gymnasium.Env]:
    make = partial(registry.reference, choice)
    return mask_in_observation(make) if has_mask(space) else make


def load(
    run: str | Path, *, environment: EnvironmentLike | None = None, network: Callable | None = None, checkpoint: int | None = None
) -> LoadedPolicy:
    """The trained policy of a run, or of its ``checkpoint`` at this step.

    ``environment`` and ``network`` are needed again where they were Python objects. Raises ``UserError`` if the run has no intact policy
    yet.
    """
    run = Path(run)
    policy, facts = read_policy(run, network, checkpoint)
    return LoadedPolicy(policy, facts, environment, checkpoint)


def evaluate_run(run: str | Path, episodes: int = 100, seed: int = 0, deterministic: bool = True) -> Evaluation:
    """Evaluate every seed of a run on fresh reference environments: ``load(run).evaluate(...)``."""
    return load(run).evaluate(episodes, seed, deterministic=deterministic)
