"""A sweep's trials: sorted into groups that one compiled program can train, trained side by side, scored."""

import copy
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from thorndike import startup
from thorndike.api.building import Job, Lanes, Request, build_config, build_from_config, build_job
from thorndike.api.loading import bounded, reference_engines
from thorndike.environments import registry, wrappers
from thorndike.errors import UserError
from thorndike.training.host_source import HostSource
from thorndike.training.lanes import Trained, finite_actors, score_lanes, train_lanes
from thorndike.training.policy import Policy
from thorndike.training.runner import agent_keys
from thorndike.training.segment import RUN_ONCE
from thorndike.training.sweep_directory import TrialRow
from thorndike.training.sweep_ranges import Settings
from thorndike.training.varied import Build, LaneSettings, find_traced, form_of, numbers_of, settle, varied
from thorndike.types import Algorithm, EnvSpec

Numbered: TypeAlias = tuple[int, Settings]
"""A trial: its number, and the settings that are swept."""

LANES_ON_CPU, LANES_ON_ACCELERATOR = 16, 256


class Group(NamedTuple):
    """Trials that one compiled program can train."""

    config: dict[str, object]
    """All settings of its first trial."""
    forms: dict[str, str]
    """The settings in which its agents may differ, and the form of each."""
    structural: dict[str, str]
    """Numbers that were tried and cannot differ within a program, and why."""
    trials: list[Numbered]


class Batch(NamedTuple):
    """Trials that are trained at once."""

    group: Group
    trials: list[Numbered]
    size: int
    """Trials that the program has room for: the last one is repeated to fill it."""


def trials_at_once(seeds: int, platform: str) -> int:
    """Trials that are trained side by side at most. On a CPU lanes take turns, so that few of them lose nothing and are kept sooner."""
    return max(1, (LANES_ON_CPU if platform == "cpu" else LANES_ON_ACCELERATOR) // seeds)


def check_trials(request: Request, spec: EnvSpec, trials: Sequence[Numbered]) -> None:
    """Raises ``UserError`` for a trial whose settings do not fit together, before any is trained."""
    for number, settings in trials:
        try:
            build_from_config(request.algorithm, build_config(request.algorithm, {**request.config, **settings}), spec, None)
        except UserError as error:
            told = ", ".join(f"{name}={value}" for name, value in settings.items())
            raise UserError(f"trial {number} ({told}) cannot be: {error}") from error


def group_trials(request: Request, spec: EnvSpec, trials: Sequence[Numbered]) -> list[Group]:
    """The trials sorted by what cannot differ within a program, in the order in which they come."""
    found: dict[str, Group] = {}
    candidates: dict[str, Group] = {}
    for numbered in trials:
        settings = numbered[1]
        forms = {name: form_of(value) for name, value in settings.items()}
        likely = _key({name: forms[name] or [value] for name, value in settings.items()})
        if likely not in candidates:
            candidates[likely] = _probed(request, spec, settings, forms)
        like = candidates[likely]
        key = likely + _key({name: settings[name] for name in like.structural})
        if key not in found:
            found[key] = like._replace(config={**request.config, **settings}, trials=[])
        found[key].trials.append(numbered)
    return list(found.values())


def batches(groups: Sequence[Group], at_once: int, one_size: int | None = None) -> list[Batch]:
    """Every group cut into batches of one size, as equal as can be; ``one_size`` if every program is to have that size."""
    made: list[Batch] = []
    for group in groups:
        count = len(group.trials)
        size = one_size or math.ceil(count / math.ceil(count / at_once))
        made += [Batch(group, group.trials[start : start + size], size) for start in range(0, count, size)]
    return made


class TrialRunner:
    """Trains and scores batches; programs are kept as long as the batches that come need them."""

    def __init__(self, request: Request, choice: registry.Choice, episodes: int) -> None:
        """``request`` holds the settings that are not swept; ``episodes`` score each seed."""
        self._request, self._choice, self._episodes = request, choice, episodes
        self._jobs: dict[str, Job] = {}
        self.compile_s = 0.0

    def run(self, batch: Batch, tell: Callable[[int], None]) -> list[TrialRow]:
        """Train and score a batch: a row a trial. ``tell`` is given the steps that each lane has made."""
        if isinstance(self._job(batch).source, HostSource):
            # Its environments are processes, or hold files open.
            key = _program(batch)
            with closing(self._jobs.pop(key)) as job:
                return self._run(job, batch, tell)
        return self._run(self._job(batch), batch, tell)

    def _run(self, job: Job, batch: Batch, tell: Callable[[int], None]) -> list[TrialRow]:
        before = job.runner.compile_seconds()
        padded = [*batch.trials, *batch.trials[-1:] * (batch.size - len(batch.trials))]
        settings = _lane_settings(batch.group, [own for _, own in padded], self._request.seeds)
        agents = self._agents(batch)
        build = self._build(batch.group, job.wrapper.spec(job.spec))
        keys = agent_keys(self._request.seed, jnp.asarray(agents, jnp.uint32)).learner
        own = jax.jit(lambda settings, keys: settle(build, batch.group.forms, settings, keys), compiler_options=RUN_ONCE)(settings, keys)
        carry = job.runner.init()._replace(learner=own)
        trained = train_lanes(job.runner, carry, job.plan.iterations, job.plan.log_every, tell)
        self.compile_s += job.runner.compile_seconds() - before
        return _rows(batch, trained, self._scores(job, trained, agents), self._request.seeds)

    def _scores(self, job: Job, trained: Trained, agents: Sequence[int]) -> tuple[float, ...]:
        source = job.source.source if isinstance(job.source, HostSource) else job.source
        shown = wrappers.exported(job.wrapper, source.statistics(trained.carry.source))
        actors = finite_actors(jax.vmap(job.algorithm.actor)(trained.carry.learner))
        policy = Policy(job.algorithm, wrappers.from_settings(shown.settings), job.spec, actors, shown.statistics, best=0)
        asked = self._request
        choice = registry.resolve(asked.environment, env_kwargs=asked.env_kwargs, max_episode_steps=asked.max_episode_steps)
        engines = reference_engines(bounded(choice), job.spec.observation_space)
        return score_lanes(policy, engines, agents, self._episodes, asked.seed)

    def _job(self, batch: Batch) -> Job:
        key = _program(batch)
        if key not in self._jobs:
            group, seeds = batch.group, self._request.seeds
            first = {name: numbers_of(group.config[name]) for name in group.forms}

            def learner(spec: EnvSpec) -> Algorithm:
                build = self._build(group, spec)
                return varied(build, group.forms, build({}), first)

            request = self._request._replace(config=group.config, seeds=batch.size * seeds)
            self._jobs[key] = build_job(
                request, self._choice, None, None, lanes=Lanes(self._agents(batch), learner), devices=startup.device_count(None)
            )
        return self._jobs[key]

    def _agents(self, batch: Batch) -> tuple[int, ...]:
        return tuple(range(self._request.seeds)) * batch.size

    def _build(self, group: Group, spec: EnvSpec) -> Build:
        return _builder(self._request.algorithm, group.config, spec)


def _builder(algorithm: str, config: Mapping[str, object], spec: EnvSpec) -> Build:
    settings = build_config(algorithm, config)

    def build(given: Mapping[str, object]) -> Algorithm:
        # The copy is not checked again: a traced number has no value to be compared with bounds, and the concrete ones have been.
        altered = copy.copy(settings)
        for name, value in given.items():
            object.__setattr__(altered, name, value)
        return build_from_config(algorithm, altered, spec, None)

    return build


def _probed(request: Request, spec: EnvSpec, settings: Settings, forms: Mapping[str, str | None]) -> Group:
    """A group without trials: which settings of the first such trial can differ within a program."""
    numbers = {name: value for name, value in settings.items() if forms[name] is not None}
    config = {**request.config, **settings}
    found = find_traced(_builder(request.algorithm, config, spec), numbers, spec)
    return Group(config, {name: str(forms[name]) for name in found.traced}, found.structural, [])


def _program(batch: Batch) -> str:
    """What two batches share that can be trained by one program."""
    fixed = {name: value for name, value in batch.group.config.items() if name not in batch.group.forms}
    return _key({"fixed": fixed, "forms": batch.group.forms, "size": batch.size})


def _lane_settings(group: Group, trials: Sequence[Settings], seeds: int) -> LaneSettings:
    """The settings in which agents differ, as arrays ``[trials * seeds]``."""
    return {
        name: tuple(jnp.repeat(jnp.stack(column), seeds) for column in zip(*[numbers_of(own[name]) for own in trials], strict=True))
        for name in group.forms
    }


def _rows(batch: Batch, trained: Trained, scores: Sequence[float], seeds: int) -> list[TrialRow]:
    rows = []
    for place, (number, settings) in enumerate(batch.trials):
        lanes = slice(place * seeds, (place + 1) * seeds)
        failures = trained.failures[lanes]
        told = tuple(None if failed or not math.isfinite(score) else score for score, failed in zip(scores[lanes], failures, strict=True))
        curve = tuple(tuple(float(x) if math.isfinite(x) else None for x in point[lanes]) for point in trained.returns)
        rows.append(TrialRow(number, trained.steps[-1], settings, told, failures, trained.steps, curve))
    return rows


def _key(content: Mapping[str, object]) -> str:
    return json.dumps(content, sort_keys=True, default=str)
