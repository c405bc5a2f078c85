"""``train`` and ``resume``: from what was asked for to a run directory with a trained policy."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from thorndike import startup
from thorndike.api.building import EnvironmentLike, Job, Request, build_job, check_algorithm, full_request, is_large
from thorndike.api.exporting import export_policy
from thorndike.api.planning import plan_run
from thorndike.api.training_result import Result
from thorndike.environments import registry
from thorndike.errors import UserError
from thorndike.networks.network import NetworkBuilder
from thorndike.training.metrics import LogPoint
from thorndike.training.presets import find_preset
from thorndike.training.progress import Progress
from thorndike.training.run_directory import checkpoints, facts, intact, new_run_directory, read_run, write_json
from thorndike.training.runner import Carry
from thorndike.training.session import START, Outcome, Progressed, restore, run_session
from thorndike.types import Wrapper


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
    wrappers: Sequence[Wrapper] | None = None,
    network: NetworkBuilder | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    env_timeout: float | None = None,
    progress: bool = False,
    command: str | None = None,
) -> Result:
    """Train ``seeds`` independent agents and keep everything in a new run directory.

    ``steps`` are environment steps of each seed. What is not given comes from the environment's preset, then from the algorithm's
    defaults; ``preset="none"`` ignores presets. ``wrappers`` are those of ``thorndike.environments.wrappers``; ``network`` builds a
    network of your own. ``env_timeout`` is how many seconds a step of an environment in a process of its own may take (60 by default), a
    reset twice that. Raises ``UserError`` for anything that cannot be.
    """
    check_algorithm(algorithm)
    if not 0 <= seed < 2**32 or seeds < 1:
        raise UserError(f"a seed is a number from 0 to 2^32 - 1, and there is at least one; got seed={seed}, seeds={seeds}")
    choice = registry.resolve(environment, engine=engine, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    if algorithm == "planning":
        return plan_run(choice, settings or {}, output, name, command)
    found = find_preset(algorithm, choice.id, preset)
    request = full_request(algorithm, choice, found, wrappers, settings or {}, steps, num_envs, seeds, seed, checkpoint_every)
    backend = startup.choose_device(device, is_large(algorithm, choice))
    job = build_job(request, choice, wrappers, network, env_timeout)
    run = new_run_directory(output, choice.id, algorithm, name)
    objects = {"network": "user" if network else "default", "environment_object": not isinstance(environment, str)}
    record = {**facts(), "status": "running", "command": command, "device": backend, **objects, **_as_json(request)}
    return _conduct(run, record, job, progress, fresh=True)


def resume(
    run: str | Path,
    *,
    steps: int | None = None,
    environment: EnvironmentLike | None = None,
    wrappers: Sequence[Wrapper] | None = None,
    network: NetworkBuilder | None = None,
    env_timeout: float | None = None,
    progress: bool = False,
) -> Result:
    """Go on with an interrupted run from its last checkpoint, or train a finished one further, to ``steps`` in all.

    ``environment``, ``wrappers`` and ``network`` are needed again where they were Python objects. Raises ``UserError`` if the run cannot
    go on.
    """
    run = Path(run)
    record = read_run(run)
    if record["algorithm"] == "planning":
        raise UserError(f"{run} is a plan: it is complete, there is nothing to resume")
    _need_objects(run, record, environment, wrappers, network)
    request = Request(**{field: record[field] for field in Request._fields})
    if steps is not None:
        request = request._replace(steps=steps)
    processors = str(record["processors"])
    record["device"] = startup.choose_device(record["device"], False, int(processors) if processors.isdigit() else None)
    choice = registry.resolve(
        request.environment if environment is None else environment,
        engine=request.engine,
        env_kwargs=request.env_kwargs,
        max_episode_steps=request.max_episode_steps,
    )
    job = build_job(request, choice, wrappers, network, env_timeout)
    return _conduct(run, {**record, **_as_json(request), "status": "running"}, job, progress, fresh=False)


def runs(output: str | Path = "runs") -> list[Path]:
    """Every run below ``output``, oldest first."""
    return sorted((path.parent for path in Path(output).glob("*/*/*/run.json")), key=lambda path: path.name)


def _conduct(run: Path, record: dict[str, object], job: Job, progress: bool, fresh: bool) -> Result:
    """Run the session; whatever happens, ``run.json`` says how it ended."""
    write_json(run / "run.json", record)
    wall_began, cpu_began = time.perf_counter(), time.process_time()

    def export(carry: Carry, points: Sequence[LogPoint]) -> None:
        export_policy(run, record, job, carry, points)

    try:
        carry, start = (job.runner.init(), START) if fresh else restore(run, job.runner, job.source)
        with Progress(job.request.steps, progress, done_steps=start.iteration * job.runner.steps_per_iteration) as bar:
            before = start._replace(
                wall_s=start.wall_s + time.perf_counter() - wall_began, cpu_s=start.cpu_s + time.process_time() - cpu_began
            )
            outcome = run_session(run, job.runner, job.source, job.plan, carry, before, export, bar)
    except BaseException as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        write_json(run / "run.json", {**record, "status": status, "error": f"{type(error).__name__}: {error}"})
        raise
    finally:
        job.close()
    result = _result(run, job, start, outcome)
    times = {"wall_s": outcome.wall_s, "cpu_s": outcome.cpu_s, "compile_s": result.compile_s, "steps_done": outcome.steps}
    write_json(run / "run.json", {**record, "status": outcome.status, **times})
    return result


def _result(run: Path, job: Job, start: Progressed, outcome: Outcome) -> Result:
    compile_s = job.runner.compile_seconds()
    made = (outcome.steps - start.iteration * job.runner.steps_per_iteration) * job.request.seeds
    wall, cpu = outcome.wall_s - start.wall_s, outcome.cpu_s - start.cpu_s
    returns = outcome.recent[-1].returns if outcome.recent else []
    return Result(
        run=run,
        status=outcome.status,
        steps=outcome.steps,
        seeds=job.request.seeds,
        wall_s=outcome.wall_s,
        cpu_s=outcome.cpu_s,
        compile_s=compile_s,
        steps_per_s=made / max(wall - job.runner.compile_wall_seconds(), 1e-9),
        steps_per_cpu_s=made / max(cpu - compile_s, 1e-9),
        mean_return=sum(returns) / len(returns) if returns else math.nan,
    )


def _need_objects(
    run: Path, record: dict, environment: object | None, wrappers: Sequence[Wrapper] | None, network: NetworkBuilder | None
) -> None:
    """Raises ``UserError`` if something that was a Python object is not given again, or there is nothing to go on from."""
    if record["network"] == "user" and network is None:
        raise UserError(f"{run} was trained with a network of your own; go on in Python: td.resume(run, network=...)")
    if record["environment_object"] and environment is None:
        raise UserError(f"{run} was trained on an environment object; go on with it in Python: td.resume(run, environment=...)")
    if wrappers is None and not all(record["wrappers"]):
        raise UserError(f"{run} was trained with wrappers that hold your own functions; go on in Python: td.resume(run, wrappers=[...])")
    if not any(intact(folder) for folder in checkpoints(run)):
        raise UserError(f"{run} has no intact checkpoint to go on from; train again, or lower --checkpoint-every")


def _as_json(request: Request) -> dict[str, object]:
    return json.loads(json.dumps(request._asdict(), default=str))
