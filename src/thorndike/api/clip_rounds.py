"""Learning from choices in rounds: record clips, have them judged, learn a reward, train on it; again, with the policy that came of it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

from thorndike import startup
from thorndike.api.building import DEFAULT_STEPS, check_algorithm, choose, is_large, prepare_devices
from thorndike.api.clips import LENGTH, QUESTION, collect_clips, fit_clips, judge_clips
from thorndike.api.training import resume, runs, train
from thorndike.api.training_result import Result
from thorndike.clips.choices import ask, left_to_judge
from thorndike.clips.folder import REWARDS, collections, number_of_collections, numbered
from thorndike.clips.reward_fitting import config_of
from thorndike.errors import UserError
from thorndike.training.json_files import Json, as_bytes, parse_object, read_object
from thorndike.training.run_directory import checkpoints, write_json

PLAN, RUNS = "training.json", "runs"
CHOICES, ROUNDS = 500, 5
FIRST_SHARE = 0.25
"""Of the choices, between clips of random actions, before anything is learnt: Christiano et al. 2017, appendix A.1."""


WHILE_ASKING = 0.5
"""Of the steps, divided among the rounds; the rest is trained on the reward from all choices. The paper, too, asks less and less."""


class SimulatedRater(NamedTuple):
    """A program that judges in place of people: see ``judge_clips``."""

    temperature: float = 1.0
    error_rate: float = 0.0


class Rounds(NamedTuple):
    """How far learning from choices has come."""

    status: str
    """``finished``, ``interrupted``, or ``waiting`` for people to judge."""
    folder: Path
    round: int
    """That it stands in, from 1 on."""
    rounds: int
    left: int
    """Pairs that wait to be judged."""
    accuracy: float | None
    """Of the newest reward, on choices that it had not learnt from."""
    run: Path | None
    result: Result | None
    """Of the training that was done now, if there was any."""


Told = Callable[[str], None]


def train_on_choices(
    algorithm: str,
    environment: str,
    to: str | Path,
    *,
    choices: int = CHOICES,
    rounds: int = ROUNDS,
    simulated: SimulatedRater | None = None,
    films: bool | None = None,
    length: int = LENGTH,
    question: str = QUESTION,
    fit: Mapping[str, object] | None = None,
    steps: int | None = None,
    seeds: int = 1,
    seed: int = 0,
    num_envs: int | None = None,
    settings: Mapping[str, object] | None = None,
    preset: str | None = None,
    engine: str = "auto",
    device: str = "auto",
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
    progress: bool = False,
    told: Told | None = None,
) -> Rounds:
    """Train an agent from ``choices`` between pairs of clips, in ``rounds``; everything is kept in the folder ``to``.

    A quarter of the choices is between clips of random actions. Then, ``rounds`` times, a reward is learnt from all choices so far and the
    agent trained on it for an equal share of ``steps``; before each round but the first its clips are recorded, and those pairs are asked
    on which the reward's members disagree most. ``simulated`` judges by itself; without it the call returns, ``waiting``, wherever people
    must judge (``thorndike language label --db TO/choices.db``), and the same call goes on. ``fit`` are settings of the reward. Raises
    ``UserError``.
    """
    check_algorithm(algorithm)
    choice, found = choose(algorithm, environment, preset, engine, env_kwargs, max_episode_steps)
    # Before clips are recorded: that starts JAX.
    prepare_devices(choice, seeds)
    startup.choose_device(device, is_large(algorithm, choice))
    learner = _Learner(
        steps or found.steps or DEFAULT_STEPS, seeds, seed, num_envs, dict(settings or {}), preset, engine, device, max_episode_steps
    )
    clips = _Clips(length, question, simulated is None if films is None else films)
    reward = asdict(config_of(fit or {}))
    asked = _Asked(algorithm, environment, Path(to), shares(choices, rounds), simulated, learner, reward, clips, dict(choice.env_kwargs))
    return _Work(asked, progress, told or _silent).go()


class _Learner(NamedTuple):
    """What ``train`` is asked for."""

    steps: int
    seeds: int
    seed: int
    num_envs: int | None
    settings: dict[str, object]
    preset: str | None
    engine: str
    device: str
    max_episode_steps: int | None


class _Clips(NamedTuple):
    """What ``collect_clips`` is asked for."""

    length: int
    question: str
    films: bool


class _Asked(NamedTuple):
    """What was asked for."""

    algorithm: str
    environment: str
    where: Path
    parts: list[int]
    """Choices of each round."""
    simulated: SimulatedRater | None
    learner: _Learner
    fit: Json
    clips: _Clips
    env_kwargs: dict[str, object]

    @property
    def plan(self) -> Json:
        """What must stay as it was for the same call to go on."""
        judged = None if self.simulated is None else self.simulated._asdict()
        plan: Json = {"algorithm": self.algorithm, "environment": self.environment, "choices": self.parts, "simulated": judged}
        return plan | {"learner": self.learner._asdict(), "reward": self.fit, "clips": self.clips._asdict()}


class _Work:
    """Rounds under way. What a round has left on the disk is not done again."""

    def __init__(self, asked: _Asked, progress: bool, say: Told) -> None:
        self._asked, self._progress, self._say = asked, progress, say
        self._where, self._rounds, self._seed = asked.where, len(asked.parts), asked.learner.seed
        self._result: Result | None = None
        self._accuracy: float | None = None

    def go(self) -> Rounds:
        for number in range(self._rounds):
            left = self._choices(number)
            if left:
                return self._told("waiting", number, left)
            if len(numbered(self._where / REWARDS)) <= number:
                report = fit_clips(self._where, settings=self._asked.fit, seed=(self._seed + number) % 2**32).report
                self._accuracy = report.accuracy
                right = f"{report.accuracy:.1%} of {report.held_out}" if report.held_out else "none"
                self._say(f"a reward from {report.choices} choices, right on {right} that were held out")
            if not self._train(number):
                return self._told("interrupted", number, 0)
        return self._told("finished", self._rounds - 1, 0)

    def _choices(self, number: int) -> int:
        """Record the clips of a round and have them judged; how many pairs wait for people."""
        where, asked = self._where, self._asked
        if number_of_collections(where) <= number:
            self._say(f"round {number + 1} of {self._rounds}: recording clips for {asked.parts[number]} choices")
            collect_clips(
                asked.environment, where, pairs=asked.parts[number], run=_run_in(where), length=asked.clips.length,
                question=asked.clips.question, films=asked.clips.films, env_kwargs=asked.env_kwargs,
                max_episode_steps=asked.learner.max_episode_steps, seed=self._seed,
            )  # fmt: skip
        _keep_plan(where, asked.plan)
        if number < number_of_collections(where) - 1:
            return 0
        ask(where, collections(where)[number])
        if asked.simulated is not None:
            judge_clips(where, temperature=asked.simulated.temperature, error_rate=asked.simulated.error_rate, seed=self._seed + number)
        return left_to_judge(where)

    def _train(self, number: int) -> bool:
        """Train to the end of a round; whether it came there."""
        asked, run, reward = self._asked, _run_in(self._where), numbered(self._where / REWARDS)[number]
        learner = asked.learner
        part = math.ceil(learner.steps * WHILE_ASKING / self._rounds)
        until = learner.steps if number == self._rounds - 1 else part * (number + 1)
        if run is None:
            self._result = train(
                asked.algorithm, asked.environment, steps=learner.steps, seeds=learner.seeds, seed=learner.seed, num_envs=learner.num_envs,
                settings=learner.settings, preset=learner.preset, engine=learner.engine, device=learner.device, output=self._where / RUNS,
                name="choices", checkpoint_every=part, max_episode_steps=learner.max_episode_steps, env_kwargs=asked.env_kwargs,
                reward=reward, until=until, progress=self._progress,
            )  # fmt: skip
        elif _steps_in(run) < until:
            self._result = resume(run, reward=reward, until=until, progress=self._progress)
        return self._result is None or self._result.steps >= until

    def _told(self, status: str, number: int, left: int) -> Rounds:
        return Rounds(status, self._where, number + 1, self._rounds, left, self._accuracy, _run_in(self._where), self._result)


def shares(choices: int, rounds: int) -> list[int]:
    """Choices of each round: ``FIRST_SHARE`` of them first, equal parts of the rest. Raises ``UserError`` for too few."""
    if rounds < 1 or choices < 2 * rounds:
        raise UserError(f"at least one round and two choices a round are needed; got choices={choices}, rounds={rounds}")
    if rounds == 1:
        return [choices]
    first = max(2, round(FIRST_SHARE * choices))
    each, rest = divmod(choices - first, rounds - 1)
    return [first, *(each + (number < rest) for number in range(rounds - 1))]


def _keep_plan(where: Path, plan: Json) -> None:
    """Write what was asked for, or find it there. Raises ``UserError`` for something else."""
    path, asked = where / PLAN, parse_object(as_bytes(plan), PLAN)
    if not path.exists():
        return write_json(path, asked)
    before = read_object(path)
    for name in asked:
        if before.get(name) != asked[name]:
            raise UserError(f"{where} was begun with {name} = {before.get(name)!r}: give that to go on, or choose another folder")


def _run_in(where: Path) -> Path | None:
    found = runs(where / RUNS)
    return found[0] if found else None


def _steps_in(run: Path) -> int:
    known = checkpoints(run)
    return int(known[-1].name) if known else 0


def _silent(line: str) -> None:
    del line
