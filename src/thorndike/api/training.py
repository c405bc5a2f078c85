"""``train`` and ``resume``: from what was asked for to a run directory with a trained policy."""

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import gymnasium

from thorndike import startup
from thorndike.api.building import build_algorithm, check_algorithm, config_class
from thorndike.environments import registry
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean
from thorndike.training.presets import Preset, find_preset
from thorndike.training.run_directory import checkpoints, facts, intact, new_run_directory, publish, read_run, write_json

startup.prepare()

EnvironmentLike: TypeAlias = str | gymnasium.Env | Callable[[], gymnasium.Env] | gymnasium.vector.VectorEnv

DEFAULT_STEPS = 100_000
DEFAULT_NUM_ENVS = {"ppo": 8, "dqn": 4, "q_learning": 1}
LOG_POINTS = 100
CHECKPOINTS = 10


class Result(NamedTuple):
    """What training did."""

    run: Path
    status: str
    """``finished`` or ``interrupted``."""
    steps: int
    """Environment steps of each seed."""
    seeds: int
    wall_s: float
    cpu_s: float
    compile_s: float
    """CPU seconds of compiling, included in ``cpu_s``."""
    steps_per_s: float
    """Steps of all seeds per second, compiling left out."""
    steps_per_cpu_s: float
    mean_return: float
    """Of the episodes that ended in the last log point, over all seeds; NaN if none did."""


class Request(NamedTuple):
    """All that defines a run, as ``run.json`` keeps it."""

    algorithm: str
    environment: str
    env_kwargs: dict[str, object]
    max_episode_steps: int | None
    engine: str
    config: dict[str, object]
    wrappers: list[dict[str, object]]
    preset: str
    steps: int
    seeds: int
    seed: int
    num_envs: int
    log_every: int
    checkpoint_every: int


def train(
    algorithm: str,
    environment: EnvironmentLike,
    *,
    steps: int | None = None,
    seeds: int = 1,
    seed: int = 0,
    num_envs: int | None = None,
    settings: Mapping[str, object] | None = None,
    preset: str | None = None,
    engine: str = "auto",
    device: str = "auto",
    output: str | Path = "runs",
    name: str | None = None,
    checkpoint_every: int | None = None,
    max_episode_steps: int | None = None,
    wrappers: Sequence[object] | None = None,
    network: Callable | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    progress: bool = False,
    command: str | None = None,
) -> Result:
    """Train ``seeds`` independent agents and keep everything in a new run directory.

    ``steps`` are environment steps of each seed. What is not given comes from the environment's preset, then from the algorithm's
    defaults; ``preset="none"`` ignores presets. ``wrappers`` are those of ``thorndike.environments.wrappers``; ``network`` builds a
    network of your own. Raises ``UserError`` for anything that cannot be.
    """
    check_algorithm(algorithm)
    choice = registry.resolve(environment, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    if algorithm == "planning":
        from thorndike.api.planning import plan_run

        return plan_run(choice, dict(settings or {}), output, name, command)
    found = find_preset(algorithm, choice.id, preset)
    startup.prepare(_processors(choice), device)
    request, wrapper_objects = _request(
        algorithm, choice, found, steps, seeds, seed, num_envs, settings, max_episode_steps, wrappers, env_kwargs, checkpoint_every
    )
    run = new_run_directory(output, choice.id, algorithm, name)
    job = _assemble(request, choice, network, wrapper_objects)
    record = {**facts(), "status": "running", "command": command, **_as_json(request)}
    record |= {"network": "user" if network else "default", "environment_object": not isinstance(environment, str)}
    write_json(run / "run.json", record)
    return _conduct(run, record, request, job, progress, fresh=True)


def resume(
    run: str | Path,
    *,
    steps: int | None = None,
    environment: EnvironmentLike | None = None,
    wrappers: Sequence[object] | None = None,
    network: Callable | None = None,
    progress: bool = False,
) -> Result:
    """Go on with an interrupted run from its last checkpoint, or train a finished one further, to ``steps`` in all.

    ``environment``, ``wrappers`` and ``network`` are needed again where they were Python objects. Raises ``UserError`` if the run cannot
    go on.
    """
    run = Path(run)
    record = read_run(run)
    request = Request(**{field: record[field] for field in Request._fields})
    if steps is not None:
        request = request._replace(steps=steps)
    _need_objects(run, record, environment, wrappers, network)
    startup.prepare(int(record["processors"]) if str(record.get("processors", "")).isdigit() else None)
    choice = registry.resolve(
        environment if environment is not None else request.environment,
        engine=request.engine,
        env_kwargs=request.env_kwargs,
        max_episode_steps=request.max_episode_steps,
    )
    job = _assemble(request, choice, network, wrappers)
    return _conduct(run, {**record, **_as_json(request), "status": "running"}, request, job, progress, fresh=False)


def runs(output: str | Path = "runs") -> list[Path]:
    """Every run below ``output``, oldest first."""
    return sorted((path.parent for path in Path(output).glob("*/*/*/run.json")), key=lambda path: path.name)


def _request(
    algorithm: str,
    choice: registry.Choice,
    preset: Preset,
    steps: int | None,
    seeds: int,
    seed: int,
    num_envs: int | None,
    settings: Mapping[str, object] | None,
    max_episode_steps: int | None,
    wrappers: Sequence[object] | None,
    env_kwargs: Mapping[str, object] | None,
    checkpoint_every: int | None,
) -> tuple[Request, Sequence[object] | None]:
    """What was asked for and what the preset and the defaults add to it."""
    Config = config_class(algorithm)
    steps = steps or preset.steps or DEFAULT_STEPS
    known = {field.name for field in dataclasses.fields(Config)}
    chosen = {**preset.settings, **(settings or {}), "total_steps": steps}
    for key in chosen:
        if key not in known:
            raise UserError(f"{algorithm} has no setting '{key}'{did_you_mean(key, known)}")
    config = dataclasses.asdict(Config(**{key: tuple(v) if isinstance(v, list) else v for key, v in chosen.items()}))
    envs = num_envs or preset.num_envs or DEFAULT_NUM_ENVS[algorithm]
    described = list(preset.wrappers) if wrappers is None else [getattr(wrapper, "settings", {}) for wrapper in wrappers]
    request = Request(
        algorithm, choice.id, dict(env_kwargs or {}), max_episode_steps, choice.engine, config, described, preset.name, steps, seeds, seed,
        envs, math.ceil(steps / LOG_POINTS), checkpoint_every or math.ceil(steps / CHECKPOINTS),
    )  # fmt: skip
    return request, wrappers


class Job(NamedTuple):
    """A request made ready to run."""

    algorithm: object
    wrapper: object
    source: object
    runner: object
    plan: object
    spec: object
    close: Callable[[], None]


def _assemble(request: Request, choice: registry.Choice, network: Callable | None, wrapper_objects: Sequence[object] | None) -> Job:
    from thorndike.environments import wrappers as room
    from thorndike.training.host_source import host_source
    from thorndike.training.runner import runner
    from thorndike.training.session import Plan
    from thorndike.training.sources import compiled_source

    wrapper = room.from_settings(request.wrappers) if wrapper_objects is None else room.chain(*wrapper_objects)
    indices = range(request.seeds)
    if choice.engine == "native":
        environment = registry.build_native(choice, request.num_envs)
        spec = environment.spec
    else:
        engine = registry.build_host(choice, request.num_envs * request.seeds)
        spec = engine.spec._replace(num_envs=request.num_envs)
    algorithm = build_algorithm(request.algorithm, request.config, wrapper.spec(spec), network)
    per_iteration = algorithm.needs.rollout_length * request.num_envs
    plan = Plan(*(max(1, math.ceil(n / per_iteration)) for n in (request.steps, request.log_every, request.checkpoint_every)))
    if choice.engine == "native":
        source, close = compiled_source(environment, algorithm, wrapper), lambda: None
    else:
        source, close = host_source(engine, algorithm, wrapper, request.seed, indices, plan.checkpoint_every), engine.close
    return Job(algorithm, wrapper, source, runner(algorithm, source, request.seed, indices, plan.log_every), plan, spec, close)


def _conduct(run: Path, record: dict, request: Request, job: Job, progress: bool, fresh: bool) -> Result:
    from thorndike.training.progress import Progress
    from thorndike.training.session import START, restore, run_session

    started_steps = 0
    try:
        carry, progressed = (job.runner.init(), START) if fresh else restore(run, job.runner, job.source)
        started_steps = progressed.iteration * job.runner.steps_per_iteration
        write_json(run / "run.json", record)

        def export(carry, point) -> None:
            _export(run, record, request, job, carry, point)

        with Progress(request.steps, progress, done_steps=started_steps) as bar:
            outcome = run_session(run, job.runner, job.source, job.plan, carry, progressed, export, bar)
    except BaseException as error:
        write_json(run / "run.json", {**record, "status": "failed", "error": f"{type(error).__name__}: {error}"})
        raise
    finally:
        job.close()
    compile_s = job.runner.compile_seconds()
    times = {"wall_s": outcome.wall_s, "cpu_s": outcome.cpu_s, "compile_s": compile_s, "steps_done": outcome.steps}
    write_json(run / "run.json", {**record, "status": outcome.status, **times})
    made = (outcome.steps - started_steps) * request.seeds
    wall, cpu = outcome.wall_s - progressed.wall_s, outcome.cpu_s - progressed.cpu_s
    returns = outcome.recent.returns if outcome.recent else []
    return Result(
        run, outcome.status, outcome.steps, request.seeds, outcome.wall_s, outcome.cpu_s, compile_s,
        made / max(wall - compile_s, 1e-9), made / max(cpu - compile_s, 1e-9), sum(returns) / len(returns) if returns else math.nan,
    )  # fmt: skip


def _export(run: Path, record: dict, request: Request, job: Job, carry: object, point: object) -> None:
    """Write ``policy/``: actors and statistics of every seed, and all it takes to rebuild them."""
    import shutil

    import jax

    from thorndike.environments.wrappers import exported
    from thorndike.training.space_files import space_to_json
    from thorndike.training.tree_files import save_tree

    source = job.source if hasattr(job.source, "collect") else job.source.source
    actors = jax.jit(jax.vmap(job.algorithm.actor))(carry.learner)
    aside = run / "policy.partial"
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    shown = exported(job.wrapper, source.statistics(carry.source))
    save_tree({"actor": actors, "statistics": shown.statistics}, aside / "policy.safetensors")
    returns = point.values["rollout/ep_rew_mean"] if point else [None] * request.seeds
    best = max(range(request.seeds), key=lambda i: -math.inf if returns[i] is None else returns[i])
    content = {
        "format": 1,
        "algorithm": request.algorithm,
        "config": request.config,
        "environment": request.environment,
        "environment_object": record["environment_object"],
        "network": record["network"],
        "env_kwargs": request.env_kwargs,
        "max_episode_steps": request.max_episode_steps,
        "num_envs": request.num_envs,
        "wrappers": shown.settings,
        "observation_space": space_to_json(job.spec.observation_space),
        "action_space": space_to_json(job.spec.action_space),
        "seeds": request.seeds,
        "best": best,
        "time": time.time(),
    }
    (aside / "policy.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    publish(aside, run / "policy")


def _processors(choice: registry.Choice) -> int | None:
    """One processor for XLA, unless observations are images: small programs run faster, and exactly repeatably, on one."""
    return 1


def _need_objects(run: Path, record: dict, environment: object, wrappers: object, network: object) -> None:
    if record.get("network") == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own: pass it again as network=...")
    if record["environment_object"] and environment is None:
        raise UserError(f"{run} was trained on an environment object: pass it again as environment=...")
    if wrappers is None and not all(record["wrappers"]):
        raise UserError(f"{run} was trained with wrappers that hold functions of your own: pass them all again as wrappers=[...]")
    if not any(intact(folder) for folder in checkpoints(run)):
        raise UserError(f"{run} has no intact checkpoint to go on from; train again, or lower --checkpoint-every")


def _as_json(request: Request) -> dict[str, object]:
    return json.loads(json.dumps(request._asdict(), default=str))
