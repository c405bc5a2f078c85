"""From what was asked for to a learner bound to its environment."""

import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import gymnasium

from thorndike.algorithms import ALGORITHMS
from thorndike.environments import registry, wrappers
from thorndike.environments.native.vectorize import Dynamics
from thorndike.errors import UserError
from thorndike.learning_sources import check_source
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import is_image
from thorndike.suggestions import did_you_mean
from thorndike.training.dataset_source import ENGINE, dataset_source, dataset_spec
from thorndike.training.datasets import Dataset, read_dataset
from thorndike.training.host_source import HostEngine, HostSource, host_source
from thorndike.training.presets import Preset
from thorndike.training.runner import Runner, page_length, runner
from thorndike.training.session import Plan
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm, Environment, EnvSpec, Source, Wrapper

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

EnvironmentLike: TypeAlias = str | gymnasium.Env | Callable[..., gymnasium.Env] | gymnasium.vector.VectorEnv | Environment | Dynamics

DEFAULT_STEPS = 100_000
LOG_POINTS = 100
CHECKPOINTS = 10


class Request(NamedTuple):
    """All that defines a run, as ``run.json`` keeps it."""

    algorithm: str
    environment: str
    env_kwargs: dict[str, object]
    max_episode_steps: int | None
    engine: str
    config: dict[str, object]
    wrappers: list[dict[str, object]]
    """``Wrapper.settings`` of each; empty for one that holds a function of the user's."""
    preset: str
    steps: int
    """Environment steps of each seed."""
    seeds: int
    seed: int
    num_envs: int
    log_every: int
    checkpoint_every: int
    dataset: dict[str, str] | None = None
    """``path`` and ``sha256`` of what is learnt from, where no environment is stepped; an update is then a step."""
    start_from: str | None = None
    """The offline run whose networks and dataset it began with."""


class Lanes(NamedTuple):
    """Agents that are not simply a run's seeds: those of a sweep's trials, side by side."""

    agents: tuple[int, ...]
    """The number of each in its own trial: agents of the same number begin with the same random numbers."""
    build: Callable[[EnvSpec], Algorithm]
    """spec as the learner sees it -> their learner."""


class Job(NamedTuple):
    """A request made ready to run."""

    request: Request
    algorithm: Algorithm
    wrapper: Wrapper
    spec: EnvSpec
    """The environment's own, before wrappers."""
    source: Source | HostSource
    runner: Runner
    plan: Plan
    close: Callable[[], None]


def make(
    environment: EnvironmentLike,
    num_envs: int = 1,
    *,
    engine: str = "auto",
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
    env_timeout: float | None = None,
) -> Environment | HostEngine:
    """The environments a run would train on: pure functions of a compiled engine, or a host engine to step from Python.

    ``env_timeout`` is how many seconds a step in a process of its own may take (60 by default); a reset may take twice that.
    """
    choice = registry.resolve(environment, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    if choice.engine == "native":
        return registry.build_native(choice, num_envs)
    return registry.build_host(choice, num_envs, env_timeout=env_timeout)


def check_algorithm(algorithm: str) -> None:
    """Raises ``UserError``, with a suggestion, if there is no such algorithm."""
    if algorithm not in ALGORITHMS:
        raise UserError(f"there is no algorithm '{algorithm}'{did_you_mean(algorithm, ALGORITHMS)}")


def full_config(algorithm: str, settings: Mapping[str, object]) -> dict[str, object]:
    """Every setting of an algorithm, checked. Raises ``UserError`` for an unknown name or a value out of bounds."""
    config_class = importlib.import_module(ALGORITHMS[algorithm].module).Config
    known = [field.name for field in dataclasses.fields(config_class)]
    for name in settings:
        if name not in known:
            raise UserError(f"{algorithm} has no setting '{name}'{did_you_mean(name, known)}")
    return dataclasses.asdict(build_config(algorithm, settings))


def build_config(name: str, settings: Mapping[str, object]) -> "DataclassInstance":
    """The ``Config`` of an algorithm; lists, which is what JSON and TOML make of tuples, become tuples again."""
    config_class = importlib.import_module(ALGORITHMS[name].module).Config
    return config_class(**{key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()})


def build_algorithm(name: str, config: Mapping[str, object], spec: EnvSpec, network: NetworkBuilder | None) -> Algorithm:
    """The algorithm ``name`` for an environment, from its settings. Raises ``UserError`` if they do not fit."""
    return build_from_config(name, build_config(name, config), spec, network)


def build_from_config(name: str, settings: "DataclassInstance", spec: EnvSpec, network: NetworkBuilder | None) -> Algorithm:
    """The same from a ``Config``, whose numbers may be traced. Raises ``UserError`` if they do not fit."""
    factory = getattr(importlib.import_module(ALGORITHMS[name].module), name)
    if network is None:
        return factory(settings, spec)
    if not ALGORITHMS[name].network:
        replaceable = [other for other, entry in ALGORITHMS.items() if entry.network]
        raise UserError(f"{name} has no network to replace; {', '.join(replaceable)} do")
    return factory(settings, spec, network)


def full_request(
    algorithm: str,
    choice: registry.Choice,
    preset: Preset,
    given: Sequence[Wrapper] | None,
    settings: Mapping[str, object],
    steps: int | None,
    num_envs: int | None,
    seeds: int,
    seed: int,
    checkpoint_every: int | None,
    data: Dataset | None = None,
    start_from: str | None = None,
) -> Request:
    """What was asked for, and what the preset and the defaults add to it."""
    steps = steps or preset.steps or DEFAULT_STEPS
    return Request(
        algorithm=algorithm,
        environment=choice.id,
        env_kwargs=dict(choice.env_kwargs),
        max_episode_steps=choice.max_episode_steps,
        engine=choice.engine if data is None else ENGINE,
        config=full_config(algorithm, {**preset.settings, **settings, "total_steps": steps}),
        wrappers=list(preset.wrappers) if given is None else [wrapper.settings for wrapper in given],
        preset=preset.name,
        steps=steps,
        seeds=seeds,
        seed=seed,
        num_envs=1 if data is not None else num_envs or preset.num_envs or ALGORITHMS[algorithm].num_envs,
        log_every=math.ceil(steps / LOG_POINTS),
        checkpoint_every=checkpoint_every or math.ceil(steps / CHECKPOINTS),
        dataset=None if data is None else {"path": str(data.path.absolute()), "sha256": data.sha256},
        start_from=start_from,
    )


def build_job(
    request: Request,
    choice: registry.Choice,
    given: Sequence[Wrapper] | None,
    network: NetworkBuilder | None,
    env_timeout: float | None = None,
    lanes: Lanes | None = None,
) -> Job:
    """Bind a request to its environment, learner, source and runner; ``lanes`` are other agents than its seeds, with their own learner."""
    if request.dataset is not None:
        return _offline_job(request, network)
    check_source(request.algorithm, request.environment)
    wrapper = wrappers.from_settings(request.wrappers) if given is None else wrappers.chain(*given)
    indices = range(request.seeds) if lanes is None else lanes.agents
    build = partial(build_algorithm, request.algorithm, request.config, network=network) if lanes is None else lanes.build
    if choice.engine == "native":
        environment = registry.build_native(choice, request.num_envs)
        algorithm, plan = _learner(request, environment.spec, wrapper, build)
        source: Source | HostSource = compiled_source(environment, algorithm, wrapper)
        spec, close = environment.spec, _nothing
    else:
        engine = registry.build_host(
            choice, request.num_envs * len(indices), masks=not ALGORITHMS[request.algorithm].tabular, env_timeout=env_timeout
        )
        spec, close = engine.spec._replace(num_envs=request.num_envs), engine.close
        algorithm, plan = _learner(request, spec, wrapper, build)
        source = host_source(engine, algorithm, wrapper, request.seed, indices, plan.checkpoint_every)
    bound = runner(algorithm, source, request.seed, indices)
    return Job(request, algorithm, wrapper, spec, source, bound, plan, close)


def recorded_data(dataset: Mapping[str, str]) -> Dataset:
    """The dataset that a request names. Raises ``UserError`` if it is not what it was."""
    data = read_dataset(dataset["path"])
    if data.sha256 != dataset["sha256"]:
        raise UserError(f"{data.path} was changed since the run began; put it back, or train a new run on it")
    return data


def _offline_job(request: Request, network: NetworkBuilder | None) -> Job:
    data, wrapper = recorded_data(request.dataset or {}), wrappers.chain()
    spec = dataset_spec(data)
    algorithm, plan = _learner(request, spec, wrapper, partial(build_algorithm, request.algorithm, request.config, network=network))
    source = dataset_source(data, algorithm)
    return Job(request, algorithm, wrapper, spec, source, runner(algorithm, source, request.seed, range(request.seeds)), plan, _nothing)


def is_large(request_algorithm: str, choice: registry.Choice) -> bool:
    """Whether the run is large enough for an accelerator: images, that is convolutions."""
    if ALGORITHMS[request_algorithm].tabular or choice.engine == "native":
        return False
    probe = registry.reference(choice)
    image = is_image(probe.observation_space)
    probe.close()
    return image


def _learner(request: Request, spec: EnvSpec, wrapper: Wrapper, build: Callable[[EnvSpec], Algorithm]) -> tuple[Algorithm, Plan]:
    algorithm = build(wrapper.spec(spec))
    per_iteration = algorithm.needs.rollout_length * request.num_envs
    lengths = (request.steps, request.log_every, request.checkpoint_every)
    iterations, log_every, checkpoint_every = (max(1, math.ceil(n / per_iteration)) for n in lengths)
    plan = Plan(iterations, log_every, checkpoint_every)
    if algorithm.needs.warmup_iterations >= plan.iterations:
        warmup = algorithm.needs.warmup_iterations * per_iteration
        raise UserError(f"{request.algorithm}: the first {warmup} steps only fill the memory, so {request.steps} steps would learn nothing")
    page = page_length(algorithm, request.num_envs)
    if plan.log_every > page:
        plan = plan._replace(log_every=math.ceil(plan.log_every / page) * page)
    if request.engine not in ("native", ENGINE):
        # Host environments start afresh at checkpoints; a run ends at one, so that a longer run passes through the same states.
        plan = plan._replace(iterations=math.ceil(plan.iterations / plan.checkpoint_every) * plan.checkpoint_every)
    return algorithm, plan


def _nothing() -> None:
    """Compiled environments hold nothing to close."""
