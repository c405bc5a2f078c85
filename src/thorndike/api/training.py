"""``train`` and ``resume``: from what was asked for to a run directory with a trained policy."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from thorndike import startup
from thorndike.api.building import (
    EnvironmentLike,
    Job,
    Request,
    build_job,
    check_algorithm,
    choose,
    full_request,
    is_large,
    prepare_devices,
)
from thorndike.api.exporting import export_policy
from thorndike.api.learned_rewards import begun_with, reward_of, with_change, with_reward
from thorndike.api.planning import plan_run
from thorndike.api.recorded_run import Objects, rebuild, request_in
from thorndike.api.starting import first_carry, offline_request
from thorndike.api.training_result import Result
from thorndike.errors import UserError
from thorndike.learning_sources import check_source, is_dataset
from thorndike.networks.network import NetworkBuilder
from thorndike.records import read_record
from thorndike.training.actor_threads import ActorThreads
from thorndike.training.checkpoints import KEPT, restore, save_checkpoint
from thorndike.training.datasets import read_dataset
from thorndike.training.faults import locate
from thorndike.training.json_files import Json
from thorndike.training.metrics import last_points
from thorndike.training.notices import notice
from thorndike.training.progress import Progress
from thorndike.training.run_directory import checkpoints, facts, new_run_directory, truncate_lines, write_json
from thorndike.training.run_lock import run_lock
from thorndike.training.segment import Stopwatch
from thorndike.training.session import RECENT, Keeping, NotFinite, Outcome, Start, run_session
from thorndike.types import Wrapper

SHAPES = ("net_arch", "activation")
"""The settings that the sizes of networks follow from."""

_MOST = 1_000_000
"""Seeds, or environments of a seed: more is a slip of the keyboard, and its arrays fit nowhere."""


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
    devices: int | None = None,
    output: str | Path = "runs",
    name: str | None = None,
    checkpoint_every: int | None = None,
    keep_checkpoints: int = KEPT,
    max_episode_steps: int | None = None,
    wrappers: Sequence[Wrapper] | None = None,
    network: NetworkBuilder | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    env_timeout: float | None = None,
    actor_threads: int = 0,
    actor_schedule: str = "fixed",
    env_restarts: int = 0,
    start_from: str | Path | None = None,
    reward: str | Path | None = None,
    until: int | None = None,
    progress: bool = False,
    command: str | None = None,
) -> Result:
    """Train ``seeds`` independent agents and keep everything in a new run directory.

    ``environment`` may be the folder of a dataset: a learner from data then makes ``steps`` updates, and is evaluated on the
    environment that the dataset names. ``start_from`` is such a run, whose networks and dataset an online one begins with.

    ``steps`` are environment steps of each seed. What is not given comes from the environment's preset, then from the algorithm's
    defaults; ``preset="none"`` ignores presets. ``wrappers`` are those of ``thorndike.environments.wrappers``; ``network`` builds a
    network of your own. On compiled environments the seeds share the ``devices`` there are (cores, on a CPU), as far as their number
    divides; that changes how long it takes and no result. ``env_timeout`` is how many seconds a step of an environment in a process of
    its own may take (60 by default), a reset twice that. ``actor_threads`` play host environments while the learner learns, each a pool of
    ``num_envs`` of its own, on the ``fixed`` schedule, which can be repeated, or the ``free`` one; ``env_restarts`` is how often a pool may
    be made anew. ``reward`` is a folder of clips; ``until`` pauses at a step; the ``keep_checkpoints`` newest stay. Raises ``UserError``.
    """
    _check(algorithm, seed, seeds, num_envs, keep_checkpoints)
    check_source(algorithm, environment)
    of_stepping: dict[str, object] = {"num_envs": num_envs, "wrappers": wrappers, "start_from": start_from, "devices": devices}
    of_stepping |= {"actor_threads": actor_threads, "env_restarts": env_restarts, "reward": reward, "until": until}
    data = read_dataset(str(environment)) if is_dataset(environment) else None
    if data is not None:
        of_stepping |= {"env_kwargs": env_kwargs, "max_episode_steps": max_episode_steps, "engine": None if engine == "auto" else engine}
        refuse_given(of_stepping, "a dataset is as it was recorded, and no environment is stepped")
        environment, env_kwargs, max_episode_steps = data.origin[:3]
    choice, found = choose(algorithm, environment, preset, engine, env_kwargs, max_episode_steps)
    if algorithm == "planning":
        refuse_given(of_stepping | {"seeds": seeds > 1, "network": network}, "planning computes the exact values of one table")
        return plan_run(choice, settings or {}, output, name, command)
    settings, started = _begun(start_from, algorithm, choice.id, dict(settings or {}))
    learnt, wrappers = begun_with(reward, choice.id, wrappers, found.wrappers)
    request = full_request(
        algorithm, choice, found, wrappers, settings, steps, num_envs, seeds, seed, checkpoint_every,
        ActorThreads(actor_threads, actor_schedule, env_restarts), data, started, learnt, keep_checkpoints,
    )  # fmt: skip
    if data is None:
        prepare_devices(choice, seeds, devices)
    backend = startup.choose_device(device, is_large(algorithm, choice))
    job = _until(build_job(request, choice, wrappers, network, env_timeout, devices=startup.device_count(devices)), until)
    objects = {"network": "user" if network else "default", "environment_object": not isinstance(environment, str)}
    record = {**facts(), "status": "running", "command": command, "device": backend, **objects, **as_json(request)}
    return _from_the_start(job, new_run_directory(output, choice.id, algorithm, name), record, progress)


def resume(
    run: str | Path,
    *,
    steps: int | None = None,
    environment: EnvironmentLike | None = None,
    wrappers: Sequence[Wrapper] | None = None,
    network: NetworkBuilder | None = None,
    env_timeout: float | None = None,
    reward: str | Path | None = None,
    until: int | None = None,
    progress: bool = False,
) -> Result:
    """Go on with an interrupted run from its last checkpoint, or train a finished one further, to ``steps`` in all.

    A run that was stopped before its first checkpoint begins again. ``environment``, ``wrappers`` and ``network`` are needed again where
    they were Python objects. ``reward`` is what a run that was begun with a learnt reward learns from, from here on; ``until`` pauses it at
    so many steps. Raises ``UserError`` if the run cannot go on, or another process is writing it.
    """
    run, objects = Path(run), Objects(environment, wrappers, network)
    read_record(run)
    with run_lock(run):
        # Read again: the process that held the lock may have changed it.
        record = read_record(run)
        request = request_in(record, run, objects)
        if steps is not None:
            request = request._replace(steps=steps)
        _need_checkpoint(run)
        if request.actors is not None and request.actors.get("schedule") == "free":
            notice(f"the actor threads of {run} run freely: what is trained from here on is not bit for bit what it would have been")
        if reward is not None and request.reward is None:
            raise UserError(f"{run} was not begun with a learnt reward: train a new run with one, --reward")
        with closing(_until(rebuild(record, request, run, objects, env_timeout), until)) as job:
            start = _restored(run, job)
            if reward is not None:
                stored = reward_of(reward, request.environment)
                record = with_change(record, stored, start.progressed.iteration * job.runner.steps_per_iteration)
                start = start._replace(carry=with_reward(start.carry, job, stored))
            record = {**record, **as_json(request), "status": "running"}
            _begin_record(run, record)
            return _conduct(run, record, job, progress, lambda: start)


def runs(output: str | Path = "runs") -> list[Path]:
    """Every run below ``output``, oldest first."""
    return sorted((path.parent for path in Path(output).glob("*/*/*/run.json")), key=lambda path: path.name)


def _check(algorithm: str, seed: int, seeds: int, num_envs: int | None, keep_checkpoints: int) -> None:
    check_algorithm(algorithm)
    if keep_checkpoints < KEPT:
        raise UserError(f"the {KEPT} newest checkpoints always stay, for one may be damaged; got keep_checkpoints={keep_checkpoints}")
    if max(seeds, num_envs or 1) > _MOST:
        raise UserError(f"at most {_MOST:,} seeds and environments each; got seeds={seeds}, num_envs={num_envs}")
    if not 0 <= seed < 2**32 or seeds < 1:
        raise UserError(f"a seed is a number from 0 to 2^32 - 1, and there is at least one; got seed={seed}, seeds={seeds}")


def _begun(start_from: str | Path | None, algorithm: str, environment: str, settings: Json) -> tuple[Json, str | None]:
    """Settings, and the run that training goes on from, if it does."""
    if start_from is None:
        return settings, None
    # Networks of the same size, unless they are asked for; what acts knows already how, so that nothing is drawn at random first.
    before = offline_request(Path(start_from), algorithm, environment)
    return {name: before.config[name] for name in SHAPES} | {"learning_starts": 0} | settings, str(Path(start_from).absolute())


def refuse_given(arguments: Mapping[str, object], why: str) -> None:
    """Raises ``UserError`` for an argument that has no meaning here, rather than leave it out."""
    for name, value in arguments.items():
        if value:
            raise UserError(f"{why}: leave {name} out")


def _from_the_start(job: Job, run: Path, record: Json, progress: bool) -> Result:
    with closing(job), run_lock(run):
        _begin_record(run, record)
        return _conduct(run, record, job, progress, lambda: Start(first_carry(job)))


def _until(job: Job, until: int | None) -> Job:
    """The same job, paused at so many steps: of host environments at a checkpoint, where they start afresh."""
    if until is None:
        return job
    if until < 1:
        raise UserError(f"a run is paused at one of its steps, from 1 on, not at {until}")
    every = 1 if job.request.engine == "native" else job.plan.checkpoint_every
    iterations = math.ceil(until / (job.runner.steps_per_iteration * every)) * every
    return job._replace(plan=job.plan._replace(iterations=min(iterations, job.plan.iterations)), paused=iterations < job.plan.iterations)


def _conduct(run: Path, record: Json, job: Job, progress: bool, begin: Callable[[], Start]) -> Result:
    """Run the session; whatever happens, ``run.json`` says how it ended."""
    spent = Stopwatch()
    spent.start()
    compiled_before = job.runner.compile_seconds(), job.runner.compile_wall_seconds()
    per_iteration = job.runner.steps_per_iteration
    keeping = Keeping(
        save=lambda carry, progressed: save_checkpoint(
            run, carry, job.source, progressed, per_iteration, as_json(job.request), job.request.keep_checkpoints
        ),
        export=lambda carry, points: export_policy(run, record, job, carry, points),
    )
    try:
        start = begin()
        with Progress(job.request.steps, progress, done_steps=start.progressed.iteration * per_iteration) as bar:
            spent.stop()
            outcome = run_session(run, job.runner, job.source, job.plan, start.later(spent.wall, spent.cpu), keeping, bar)
            if job.paused and outcome.status == "finished":
                outcome = outcome._replace(status="interrupted")
    except NotFinite as error:
        _note(run, {**record, "status": "failed", "error": str(error)})
        raise UserError(_explained(run, job, error)) from error
    except BaseException as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt | SystemExit) else "failed"
        _note(run, {**record, "status": status, "error": f"{type(error).__name__}: {error}"})
        raise
    result = _result(run, job, start, outcome, *compiled_before)
    times = {"wall_s": outcome.wall_s, "cpu_s": outcome.cpu_s, "compile_s": result.compile_s, "steps_done": outcome.steps}
    _note(run, {**record, "status": outcome.status, **times})
    return result


def _explained(run: Path, job: Job, error: NotFinite) -> str:
    """The error, with the first culprit found again from the last checkpoint where the engine can repeat itself."""
    if job.runner.inspect is None:
        return str(error)
    carry, first = first_carry(job), 0
    if checkpoints(run):
        carry, progressed = restore(run, job.runner, job.source, as_json(job.request))
        first = progressed.iteration
    found = locate(run, job.runner, carry, first, error.steps // job.runner.steps_per_iteration)
    return str(error) if found is None else f"{found}; training stopped, the last checkpoint is kept"


def _begin_record(run: Path, record: Json) -> None:
    try:
        write_json(run / "run.json", record)
    except OSError as error:
        raise UserError(f"{run}/run.json cannot be written: {error.strerror}; make room, or choose another folder with --output") from error


def _note(run: Path, record: Json) -> None:
    """Write how a run stands, as far as the disk lets it: training is over, and its checkpoints say the same."""
    try:
        write_json(run / "run.json", record)
    except OSError as error:
        notice(f"{run}/run.json could not be written: {error.strerror}; it does not say how the run ended")


def _restored(run: Path, job: Job) -> Start:
    if not checkpoints(run):
        notice(f"{run} was stopped before its first checkpoint: it begins again")
        truncate_lines(run / "metrics.jsonl", 0)
        return Start(first_carry(job))
    carry, progressed = restore(run, job.runner, job.source, as_json(job.request))
    return Start(carry, progressed, last_points(run, RECENT, job.request.seeds))


def _result(run: Path, job: Job, start: Start, outcome: Outcome, compiled_s: float, compiled_wall_s: float) -> Result:
    """What a session did; what had been compiled ahead of it, to restore a checkpoint, is not in its times."""
    compile_s, compile_wall_s = job.runner.compile_seconds() - compiled_s, job.runner.compile_wall_seconds() - compiled_wall_s
    before = start.progressed
    made = (outcome.steps - before.iteration * job.runner.steps_per_iteration) * job.request.seeds
    wall, cpu = outcome.wall_s - before.wall_s, outcome.cpu_s - before.cpu_s
    returns = outcome.recent[-1].returns if outcome.recent else []
    return Result(
        run=run,
        status=outcome.status,
        steps=outcome.steps,
        seeds=job.request.seeds,
        wall_s=outcome.wall_s,
        cpu_s=outcome.cpu_s,
        compile_s=compile_s,
        steps_per_s=made / max(wall - compile_wall_s, 1e-9),
        steps_per_cpu_s=made / max(cpu - compile_s, 1e-9),
        mean_return=sum(returns) / len(returns) if returns else math.nan,
        saved_steps=outcome.saved_steps,
        signal=outcome.signal,
    )


def _need_checkpoint(run: Path) -> None:
    """Raises ``UserError`` if there were checkpoints (a policy was exported at one) and all have been removed."""
    if (run / "policy").exists() and not checkpoints(run):
        raise UserError(f"{run} has no intact checkpoint to go on from: they were removed; train again")


def as_json(request: Request) -> Json:
    """A request as ``run.json`` keeps it."""
    return json.loads(json.dumps(request._asdict(), default=str))
