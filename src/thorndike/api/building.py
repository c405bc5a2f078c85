"""From what was asked for to a learner bound to its environment."""

import dataclasses
import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, cast

import gymnasium

from thorndike import startup
from thorndike.algorithms import ALGORITHMS, check_plays
from thorndike.environments import registry, wrappers
from thorndike.environments.native.vectorize import Dynamics
from thorndike.errors import UserError
from thorndike.games.game import Game
from thorndike.learning_sources import check_source
from thorndike.networks.network import NetworkBuilder
from thorndike.networks.torso import is_image
from thorndike.replay.hindsight import goal_of
from thorndike.suggestions import did_you_mean
from thorndike.training.actor_threads import SCHEDULES, ActorThreads, threaded_source
from thorndike.training.checkpoints import KEPT
from thorndike.training.dataset_source import ENGINE, dataset_source, dataset_spec
from thorndike.training.datasets import Dataset, read_dataset
from thorndike.training.devices import devices_for
from thorndike.training.host_source import HostEngine, HostSource, host_source
from thorndike.training.json_files import TEXT, Kind, check_fields, whole
from thorndike.training.memory import check_memory
from thorndike.training.presets import Preset, find_preset
from thorndike.training.runner import Runner, runner
from thorndike.training.segment import page_length
from thorndike.training.session import Plan
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm, Environment, EnvSpec, Source, Wrapper
from thorndike.user_code import lasting_name

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

EnvironmentLike: TypeAlias = str | gymnasium.Env | Callable[..., gymnasium.Env] | gymnasium.vector.VectorEnv | Environment | Dynamics | Game

NO_THREADS = ActorThreads()
_MOST_THREADS = 1_000
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
    actors: dict[str, object] | None = None
    """``ActorThreads`` that play while the learner learns, if there are any."""
    dataset: dict[str, str] | None = None
    """``path`` and ``sha256`` of what is learnt from, where no environment is stepped; an update is then a step."""
    start_from: str | None = None
    """The offline run whose networks and dataset it began with."""
    reward: dict[str, str] | None = None
    """``path`` and ``sha256`` of the learnt reward that it began with, in place of the environment's own."""
    keep_checkpoints: int = KEPT
    """How many of the newest stay."""


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
    paused: bool = False
    """Whether the plan ends before the request does."""


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


def choose(
    algorithm: str,
    environment: EnvironmentLike,
    preset: str | None,
    engine: str = "auto",
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
) -> tuple[registry.Choice, Preset]:
    """The environment that is meant, with the preset's own settings of it where none are given, and the preset. Raises ``UserError``."""
    choice = registry.resolve(environment, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    found = find_preset(algorithm, choice.id, preset)
    if found.env_kwargs:
        both = {**found.env_kwargs, **(env_kwargs or {})}
        choice = registry.resolve(environment, engine=engine, env_kwargs=both, max_episode_steps=max_episode_steps)
    return choice, found


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
    check_plays(name, spec.id, spec.game is not None and spec.game.num_players == 2)
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
    actors: ActorThreads = NO_THREADS,
    data: Dataset | None = None,
    start_from: str | None = None,
    reward: dict[str, str] | None = None,
    keep_checkpoints: int = KEPT,
) -> Request:
    """What was asked for, and what the preset and the defaults add to it."""
    check_actors(algorithm, choice, actors)
    steps = steps or preset.steps or DEFAULT_STEPS
    return Request(
        algorithm=algorithm,
        environment=lasting_name(choice.id),
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
        actors=actors._asdict() if actors.threads else None,
        dataset=None if data is None else {"path": str(data.path.absolute()), "sha256": data.sha256},
        start_from=start_from,
        reward=reward,
        keep_checkpoints=keep_checkpoints,
    )


def check_actors(algorithm: str, choice: registry.Choice, actors: ActorThreads) -> None:
    """Raises ``UserError`` if there can be no such actor threads here."""
    if actors.threads < 0 or actors.restarts < 0 or actors.schedule not in SCHEDULES:
        raise UserError(
            f"actor threads are 0 or more, on the schedule {' or '.join(SCHEDULES)}, with 0 or more restarts; got {actors.threads}, "
            f"'{actors.schedule}', {actors.restarts}"
        )
    if not actors.threads:
        if actors.restarts:
            raise UserError("environments are made anew by actor threads only: give --actor-threads 1 (or more) beside --env-restarts")
        return
    if choice.engine == "native":
        lag = " or set policy_lag, the same delay in a compiled loop," if "policy_lag" in full_config(algorithm, {}) else ""
        raise UserError(
            f"{choice.id} is compiled together with its learner, which needs no threads: leave --actor-threads out,{lag} "
            "or give --engine gymnasium"
        )
    if isinstance(choice.origin, gymnasium.vector.VectorEnv):
        raise UserError(f"{choice.id} is one vector, and each actor thread needs its own: give the id or class of its environment")


def build_job(
    request: Request,
    choice: registry.Choice,
    given: Sequence[Wrapper] | None,
    network: NetworkBuilder | None,
    env_timeout: float | None = None,
    lanes: Lanes | None = None,
    devices: int = 1,
) -> Job:
    """Bind a request to its environment, learner, source and runner; ``lanes`` are other agents than its seeds, with their own learner.

    On compiled environments at most ``devices`` share the agents.
    """
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
        engine = partial(
            registry.build_host,
            choice,
            request.num_envs * len(indices),
            masks=not ALGORITHMS[request.algorithm].tabular,
            env_timeout=env_timeout,
        )
        spec, source, algorithm, plan, close = _on_host(request, engine, wrapper, build, indices)
    if not algorithm.needs.on_policy:
        source_spec = (source.source if isinstance(source, HostSource) else source).spec
        buffer_size = request.config.get("buffer_size")
        check_memory(
            request.algorithm,
            algorithm,
            len(indices),
            buffer_size if isinstance(buffer_size, int) else None,
            twice=choice.engine != "native" and (len(indices) > 1 or source_spec.frames == 1),
        )
    bound = runner(algorithm, source, request.seed, indices, devices_for(len(indices), devices))
    return Job(request, algorithm, wrapper, spec, source, bound, plan, close)


def prepare_devices(choice: registry.Choice, seeds: int, at_most: int | None = None) -> None:
    """Before JAX chooses its devices: as many cores as can share the seeds count as devices, where the environment is compiled."""
    if choice.engine == "native":
        startup.count_cores_as_devices(devices_for(seeds, min(startup.cores(), at_most or seeds)))


def _on_host(
    request: Request, make: Callable[[], HostEngine], wrapper: Wrapper, build: Callable[[EnvSpec], Algorithm], indices: Sequence[int]
) -> tuple[EnvSpec, HostSource, Algorithm, Plan, Callable[[], None]]:
    """Spec, source, learner, plan and how to close the environments of a host engine. Raises ``UserError``."""
    engines = [make()]
    try:
        spec = engines[0].spec._replace(num_envs=request.num_envs)
        algorithm, plan = _learner(request, spec, wrapper, build)
        if not request.actors:
            source = host_source(engines[0], algorithm, wrapper, request.seed, indices, plan.checkpoint_every)
            return spec, source, algorithm, plan, engines[0].close
        actors = actor_threads(request)
        if not algorithm.needs.on_policy:
            raise UserError(
                f"{request.algorithm} learns from a replay memory; actor threads feed learners such as impala, a3c, ppo and a2c"
            )
        while len(engines) < actors.threads:
            engines.append(make())
    except BaseException:
        for engine in engines:
            engine.close()
        raise
    threaded = threaded_source(engines, make, algorithm, wrapper, request.seed, indices, plan.checkpoint_every, actors)
    return spec, threaded.source, algorithm, plan, threaded.close


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
    if request.config.get("goal_selection_strategy", "none") != "none":
        goal_of(spec)
        if wrapper.name:
            raise UserError(
                f"{request.algorithm}: hindsight needs goals as the environment gives them: leave out the wrapper {wrapper.name}"
            )
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


def actor_threads(request: Request) -> ActorThreads:
    """The actor threads of a request. Raises ``UserError`` where ``run.json`` was changed to what cannot be."""
    fields: dict[str, Kind] = {"threads": whole(1, _MOST_THREADS), "schedule": TEXT, "restarts": whole(0)}
    actors = request.actors or {}
    check_fields(actors, fields, Path("run.json"))
    return ActorThreads(cast(int, actors["threads"]), cast(str, actors["schedule"]), cast(int, actors["restarts"]))


def _nothing() -> None:
    """Compiled environments hold nothing to close."""
