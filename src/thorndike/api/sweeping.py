"""``sweep``: which settings are best, which matter, and what the best are worth on seeds that did not choose them."""

import importlib.util
import json
import math
import signal
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from thorndike import startup
from thorndike.algorithms import ALGORITHMS
from thorndike.api.building import Request, check_algorithm, choose, full_config, full_request, is_large, prepare_devices
from thorndike.api.loading import load
from thorndike.api.recorded_run import refuse_code
from thorndike.api.sweep_trials import Numbered, TrialRunner, batches, check_trials, group_trials, trials_at_once
from thorndike.api.training import as_json, resume, train
from thorndike.config_fields import read_config_fields
from thorndike.environments import registry, wrappers
from thorndike.errors import UserError
from thorndike.plotting.sweep import plot_sweep
from thorndike.statistics.sweeps import Effect, Factor, best_trial, effects_of, filled_scores
from thorndike.training.evaluation import Evaluation
from thorndike.training.json_files import Json, blamed_on
from thorndike.training.machine import differences
from thorndike.training.notices import notice
from thorndike.training.progress import Progress
from thorndike.training.run_directory import facts, read_run, write_json
from thorndike.training.run_lock import run_lock
from thorndike.training.segment import Stopwatch
from thorndike.training.stopping import Terminated
from thorndike.training.sweep_directory import (
    FACTS,
    PICTURE,
    SWEEP_FORMAT,
    TrialRow,
    add_trials,
    new_sweep_directory,
    read_sweep,
    read_trials,
)
from thorndike.training.sweep_ranges import Over, Search, Settings, Swept, chosen_search, listed_trials, swept_settings
from thorndike.training.sweep_search import check_search, proposals, round_size
from thorndike.types import EnvSpec

EPISODES, FRESH_SEEDS, FRESH_EPISODES = 20, 10, 100
LOG_POINTS = 20
_FRESH = 0x46524553
"""Separates the winner's fresh seeds from those that chose it."""


class Winner(NamedTuple):
    """The best trial, and what its settings are worth on fresh seeds."""

    trial: int
    settings: Settings
    mean: float
    """Its mean score in the sweep: it won because it was the best of many, so this is optimistic."""
    run: Path
    """An ordinary run with its settings, and other seeds."""
    seed: int
    """That run's seed."""
    fresh: Evaluation
    """Of that run, ``FRESH_EPISODES`` episodes a seed."""


class Sweep(NamedTuple):
    """What a sweep found."""

    path: Path
    algorithm: str
    environment: str
    search: str
    """``grid``, ``random`` or ``optuna``."""
    swept: tuple[Swept, ...]
    trials: tuple[TrialRow, ...]
    effects: tuple[Effect, ...]
    winner: Winner

    def plot(self, path: str | Path) -> Path:
        """Draw a response curve for each setting into an image file (PNG, SVG or PDF by its ending)."""
        return _draw(self.trials, self.swept, self.effects, self.winner.trial, self.environment, self.algorithm, Path(path))


class _Asked(NamedTuple):
    """A sweep made ready to run."""

    path: Path
    record: Json
    request: Request
    """With the settings that are not swept."""
    choice: registry.Choice
    swept: tuple[Swept, ...]
    search: Search


def sweep(
    algorithm: str,
    environment: str,
    *,
    over: Over,
    trials: int | None = None,
    search: str = "auto",
    seeds: int = 3,
    steps: int | None = None,
    seed: int = 0,
    num_envs: int | None = None,
    settings: Mapping[str, object] | None = None,
    preset: str | None = None,
    engine: str = "auto",
    device: str = "auto",
    episodes: int = EPISODES,
    fresh_seeds: int = FRESH_SEEDS,
    output: str | Path = "runs",
    name: str | None = None,
    max_episode_steps: int | None = None,
    env_kwargs: Mapping[str, object] | None = None,
    progress: bool = False,
    command: str | None = None,
) -> Sweep:
    """Train every combination of the settings in ``over`` (or ``trials`` of them), ``seeds`` agents each, and run the best again.

    ``over`` maps a setting to values, or to a text: ``"1e-4,3e-4"``, ``"uniform(0,0.02)"``, ``"log(1e-5,1e-2)"``. Lists alone make a grid,
    unless ``trials`` asks for fewer; with a range trials are random (20 by default); ``search="optuna"`` lets Optuna choose them. A trial's
    score is the mean return of its greedy policies over ``episodes`` fresh episodes a seed. The best is trained again on ``fresh_seeds``
    other seeds. Raises ``UserError`` for anything that cannot be.
    """
    check_algorithm(algorithm)
    swept = swept_settings(over, read_config_fields(algorithm), algorithm, settings or {})
    found = chosen_search(swept, search, trials)
    check_search(found)
    if min(seeds, episodes, fresh_seeds) < 1 or not 0 <= seed < 2**32:
        raise UserError(
            f"seeds, episodes and fresh_seeds are at least 1, seed is from 0 to 2^32 - 1; got {seeds}, {episodes}, {fresh_seeds}, {seed}"
        )
    if algorithm == "planning" or not isinstance(environment, str):
        raise UserError("a sweep trains a learner on an environment that a text names (an id, module:Id or path/to/file.py:ClassName)")
    choice, found_preset = choose(algorithm, environment, preset, engine, env_kwargs, max_episode_steps)
    request = full_request(algorithm, choice, found_preset, None, settings or {}, steps, num_envs, seeds, seed, None)
    request = request._replace(log_every=math.ceil(request.steps / LOG_POINTS))
    prepare_devices(choice, seeds)
    backend = startup.choose_device(device, is_large(algorithm, choice))
    if found.kind != "optuna":
        check_trials(request, _learner_spec(request, choice), list(enumerate(listed_trials(swept, found, seed))))
    path = new_sweep_directory(output, choice.id, algorithm, name)
    record: Json = {
        **facts(),
        "format": SWEEP_FORMAT,
        "status": "running",
        "command": command,
        "device": backend,
        **as_json(request),
        "fixed": dict(settings or {}),
        "over": {each.name: each.written() for each in swept},
        "search": found.kind,
        "trials": found.trials,
        "at_once": trials_at_once(seeds, backend),
        "episodes": episodes,
        "fresh_seeds": fresh_seeds,
        "fresh_seed": int(np.random.SeedSequence([seed, _FRESH]).generate_state(1)[0]),
        "name": name,
    }
    return _conduct(_Asked(path, json.loads(json.dumps(record, default=str)), request, choice, swept, found), progress)


def resume_sweep(path: str | Path, *, progress: bool = False) -> Sweep:
    """Go on with an interrupted sweep: it ends with the same numbers as one that was never interrupted. Raises ``UserError``."""
    path = Path(path)
    record = read_sweep(path)
    refuse_code(path, str(record["environment"]))
    processors = str(record["processors"])
    device = startup.choose_device(str(record["device"]), False, int(processors) if processors.isascii() and processors.isdigit() else None)
    found = differences(record, {**facts(), "device": device})
    if found:
        notice(f"the last bits may differ from those that {path} had: {'; '.join(found)}")
    with blamed_on(path / FACTS):
        request = Request(**{field: record[field] for field in Request._fields if field in record})  # type: ignore[arg-type]
        check_algorithm(request.algorithm)
        full_config(request.algorithm, {name: tuple(value) if isinstance(value, list) else value for name, value in request.config.items()})
        known = read_config_fields(request.algorithm)
        swept = swept_settings(cast(Over, record["over"]), known, request.algorithm, cast(Json, record["fixed"]))
        search = Search(str(record["search"]), cast(int, record["trials"]))
        choice = registry.resolve(
            request.environment, engine=request.engine, env_kwargs=request.env_kwargs, max_episode_steps=request.max_episode_steps
        )
    return _conduct(_Asked(path, record, request, choice, swept, search), progress)


def _conduct(asked: _Asked, progress: bool) -> Sweep:
    """Trials, analysis, the winner's fresh run; whatever happens, ``sweep.json`` says how it stands."""
    path, spent = asked.path, Stopwatch()
    with run_lock(path):
        spent.start()
        write_json(path / FACTS, {**asked.record, "status": "running"})
        try:
            rows = _trained(asked, progress)
            answer = _answer(asked, rows, progress)
        except BaseException as error:
            stopped = isinstance(error, KeyboardInterrupt | SystemExit)
            write_json(path / FACTS, {**asked.record, "status": "interrupted" if stopped else "failed"})
            if stopped:
                kept = len(read_trials(path, asked.request.seeds))
                notice(f"{kept} of {asked.search.trials} trials are kept; go on: thorndike sweep --resume {path}")
            raise
        spent.stop()
        write_json(path / FACTS, {**asked.record, "status": "finished", "wall_s": spent.wall, "cpu_s": spent.cpu, **_told(answer)})
    return answer


def _trained(asked: _Asked, progress: bool) -> list[TrialRow]:
    """Every trial, those already in ``trials.jsonl`` from there."""
    seeds, at_once = asked.request.seeds, cast(int, asked.record["at_once"])
    done = read_trials(asked.path, seeds)
    runner = TrialRunner(asked.request, asked.choice, cast(int, asked.record["episodes"]))
    spec = _learner_spec(asked.request, asked.choice)
    source = proposals(asked.swept, asked.search, asked.request.seed, at_once)
    rows: list[TrialRow] = []
    with Progress(asked.search.trials * seeds * asked.request.steps, progress) as bar:
        proposed: list[Settings] | None = next(source)
        while proposed is not None:
            numbered = list(enumerate(proposed, len(rows)))
            _check_recorded(asked.path, numbered, done)
            one_size = round_size(asked.search, at_once) if asked.search.kind == "optuna" else None
            _train_missing(asked, runner, spec, numbered, one_size, done, bar)
            rows += [done[number] for number, _ in numbered]
            means = filled_scores([row.scores for row in rows]).mean(axis=1)[-len(numbered) :]
            proposed = _next(source.send, [float(mean) for mean in means])
    return rows


def _next(send: Callable[[list[float]], list[Settings]], scores: list[float]) -> list[Settings] | None:
    try:
        return send(scores)
    except StopIteration:
        return None


def _train_missing(
    asked: _Asked,
    runner: TrialRunner,
    spec: EnvSpec,
    numbered: Sequence[Numbered],
    one_size: int | None,
    done: dict[int, TrialRow],
    bar: Progress,
) -> None:
    """Train what is not in ``done``, in the same batches as ever, and write it down batch by batch."""
    if all(number in done for number, _ in numbered):
        return
    check_trials(asked.request, spec, numbered)
    groups = group_trials(asked.request, spec, numbered)
    # Optuna's rounds differ in their groups: one program a group, of one trial, serves them all.
    size = one_size if one_size is None or len(groups) == 1 else 1
    for batch in batches(groups, cast(int, asked.record["at_once"]), size):
        if all(number in done for number, _ in batch.trials):
            continue
        seeds, before = asked.request.seeds, len(done) * asked.request.seeds * asked.request.steps
        made = len(batch.trials) * seeds
        new = runner.run(batch, lambda steps, before=before, made=made: bar.update(before + made * steps))  # type: ignore[misc]
        new = [row for row in new if row.trial not in done]
        add_trials(asked.path, new)
        done.update({row.trial: row for row in new})


def _check_recorded(path: Path, numbered: Sequence[Numbered], done: Mapping[int, TrialRow]) -> None:
    for number, settings in numbered:
        if number in done and done[number].settings != settings:
            raise UserError(f"{path} is damaged: trial {number} has other settings in trials.jsonl than sweep.json leads to; sweep again")


def _learner_spec(request: Request, choice: registry.Choice) -> EnvSpec:
    """The environment as the learner sees it."""
    wrapper = wrappers.from_settings(request.wrappers)
    if choice.engine == "native":
        return wrapper.spec(registry.build_native(choice, request.num_envs).spec)
    with closing(registry.build_host(choice, 1, masks=not ALGORITHMS[request.algorithm].tabular)) as engine:
        return wrapper.spec(engine.spec._replace(num_envs=request.num_envs))


def _answer(asked: _Asked, rows: Sequence[TrialRow], progress: bool) -> Sweep:
    """The analysis, the picture, and the winner on fresh seeds."""
    if all(score is None for row in rows for score in row.scores):
        raise UserError(f"every seed of every trial failed, the first because {rows[0].failures[0]}: sweep smaller learning rates")
    table = filled_scores([row.scores for row in rows])
    factors = [Factor(each.name, tuple(row.settings[each.name] for row in rows), each.is_range) for each in asked.swept]
    effects = effects_of(table, factors, asked.search.kind, seed=asked.request.seed)  # type: ignore[arg-type]
    best = best_trial(table)
    if importlib.util.find_spec("matplotlib") is not None:
        _draw(rows, asked.swept, effects, best, asked.request.environment, asked.request.algorithm, asked.path / PICTURE)
    winner = _rerun(asked, rows[best], float(table[best].mean()), progress)
    return Sweep(
        asked.path, asked.request.algorithm, asked.request.environment, asked.search.kind, asked.swept, tuple(rows), effects, winner
    )


def _rerun(asked: _Asked, row: TrialRow, mean: float, progress: bool) -> Winner:
    """The best trial's settings as an ordinary run on seeds that did not choose it; one that was interrupted goes on."""
    request, seed = asked.request, cast(int, asked.record["fresh_seed"])
    output, name = asked.path.parents[2], f"winner-of-{asked.path.name}"
    known = sorted(asked.path.parents[1].glob(f"{request.algorithm}/*-{name}/run.json"))
    if known:
        run, status, stopped_by = known[-1].parent, read_run(known[-1].parent).get("status"), None
        if status != "finished":
            result = resume(run, progress=progress)
            status, stopped_by = result.status, result.signal
    else:
        settings = {**request.config, **row.settings}
        settings.pop("total_steps")
        result = train(
            request.algorithm,
            request.environment,
            steps=request.steps,
            seeds=cast(int, asked.record["fresh_seeds"]),
            seed=seed,
            num_envs=request.num_envs,
            settings=settings,
            preset="none" if request.preset == "defaults" else request.preset,
            engine=request.engine,
            device=str(asked.record["device"]),
            output=output,
            name=name,
            max_episode_steps=request.max_episode_steps,
            env_kwargs=request.env_kwargs,
            progress=progress,
            command=f"thorndike sweep --resume {asked.path}",
        )
        run, status, stopped_by = result.run, result.status, result.signal
    if status == "interrupted":
        raise KeyboardInterrupt if stopped_by != signal.SIGTERM else Terminated(128 + signal.SIGTERM)
    write_json(run / "run.json", {**read_run(run), "sweep": str(asked.path)})
    return Winner(row.trial, row.settings, mean, run, seed, load(run).evaluate(FRESH_EPISODES, seed))


def _draw(
    rows: Sequence[TrialRow], swept: Sequence[Swept], effects: Sequence[Effect], best: int, environment: str, algorithm: str, path: Path
) -> Path:
    table = filled_scores([row.scores for row in rows])
    columns = {each.name: [row.settings[each.name] for row in rows] for each in swept}
    logarithmic = {each.name for each in swept if each.scale == "log"}
    return plot_sweep(effects, columns, table.mean(axis=1), best, logarithmic, f"{algorithm} on {environment}", path)


def _told(answer: Sweep) -> Json:
    """What ``sweep.json`` keeps of the answer."""
    winner, fresh = answer.winner, answer.winner.fresh
    told = {
        "effects": [
            {**effect._asdict(), "p_value": _number(effect.p_value), "points": [point._asdict() for point in effect.points]}
            for effect in answer.effects
        ],
        "winner": {
            "trial": winner.trial,
            "settings": winner.settings,
            "mean": winner.mean,
            "run": str(winner.run),
            "seed": winner.seed,
            "fresh_mean": fresh.mean,
            "fresh_ci95": fresh.ci95,
            "fresh_per_seed": fresh.per_seed,
        },
    }
    return json.loads(json.dumps(told, default=str))


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
