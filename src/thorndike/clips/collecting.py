"""Recording clips on reference environments: windows of equal length, taken from all parts of episodes, filmed or not."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, cast

import gymnasium
import numpy as np
from jaxtyping import Array

from thorndike.clips.actors import Performer
from thorndike.clips.segments import Row, Segments, segment, together
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.environments.observation_views import shown_leaves
from thorndike.errors import UserError
from thorndike.training.host_source import Pool, environment_seeds
from thorndike.training.time_shares import Clock
from thorndike.training.video import frame_of, write_film
from thorndike.types import Step

_CLIPS = 0x434C4950
"""Separates the seeds of recorded environments from all others."""
_UNLIMITED = 1_000
"""Steps over which clips are spread where episodes have no limit."""
_MOST_STEPS = 2_000_000
_WIDEST = 320
"""Pixels of a film; larger pictures are thinned out."""
_FPS = 15


class Wanted(NamedTuple):
    """What is recorded."""

    clips: int
    length: int
    """Steps of a clip."""
    num_envs: int
    seed: int
    number: int
    """Of the collection: each has environments of its own."""


class Maker:
    """Makes reference environments, and keeps them within reach, for their pictures."""

    def __init__(self, make: Callable[[], gymnasium.Env]) -> None:
        self._make, self.made = make, list[gymnasium.Env]()

    def __call__(self) -> gymnasium.Env:
        """One more."""
        self.made.append(self._make())
        return self.made[-1]


def collect(wanted: Wanted, make: Callable[[], gymnasium.Env], name: str, perform: Callable[[LoopEngine], Performer], films: Path | None,
            name_of: Callable[[int], str]) -> Segments:  # fmt: skip
    """Record so many clips; with ``films`` each is filmed there under ``name_of(place).mp4``. Raises ``UserError`` where they do not come.

    A clip ends early only where its episode terminates; one that a time limit or the next episode cuts off is left out.
    """
    maker = Maker(make)
    engine = LoopEngine([maker] * wanted.num_envs, name)
    try:
        return _Stage(wanted, engine, maker, films, name_of).play(perform(engine))
    finally:
        engine.close()


class _Stage:
    """Environments being recorded."""

    def __init__(self, wanted: Wanted, engine: LoopEngine, maker: Maker, films: Path | None, name_of: Callable[[int], str]) -> None:
        count = wanted.num_envs
        self._wanted, self._films, self._name_of, self._made = wanted, films, name_of, maker.made
        self._pool = Pool(engine, 1, count, Clock())
        self._dice = np.random.default_rng([wanted.seed, wanted.number, _CLIPS])
        limit = maker.made[0].spec.max_episode_steps if maker.made[0].spec is not None else None
        # Clips lie as far apart as they must for all of them to come from whole episodes.
        self._share = min(1.0, wanted.clips * wanted.length / (count * (limit or _UNLIMITED)))
        self._age = np.zeros(count, np.int64)
        self._rows: list[list[Row] | None] = [None] * count
        self._frames: list[list[np.ndarray]] = [[] for _ in range(count)]
        self._found: list[Segments] = []

    def play(self, performer: Performer) -> Segments:
        wanted, pool = self._wanted, self._pool
        obs = pool.reset(environment_seeds(wanted.seed, [wanted.number], wanted.num_envs, _CLIPS))
        performer.begin(obs)
        for _ in range(_MOST_STEPS // wanted.num_envs):
            action = performer.act()
            self._begin_windows()
            raw = pool.step(cast(Array, action))
            leaves = [np.asarray(leaf) for leaf in shown_leaves(obs)]
            for row in range(wanted.num_envs):
                if raw.valid[0, row]:
                    self._keep(row, tuple(leaf[0, row] for leaf in leaves), action[0, row], raw)
            if len(self._found) >= wanted.clips:
                return together(self._found[: wanted.clips])
            performer.see(raw)
            obs = raw.obs
        raise UserError(
            f"{len(self._found)} of {wanted.clips} clips were found in {_MOST_STEPS:,} steps: are episodes shorter than {wanted.length} "
            "steps? Record shorter clips, --length"
        )

    def _begin_windows(self) -> None:
        """A window may begin at every ``length``-th step of an episode; each is filmed before it is acted in."""
        for row in range(self._wanted.num_envs):
            if self._age[row] % self._wanted.length == 0:
                self._rows[row] = [] if self._dice.random() < self._share else None
            if self._films is not None and self._rows[row] is not None:
                self._frames[row].append(_small(frame_of(self._made[row])))

    def _keep(self, row: int, obs: tuple[np.ndarray, ...], action: np.ndarray, raw: Step) -> None:
        rows = self._rows[row]
        self._age[row] += 1
        ended = bool(raw.terminated[0, row] or raw.truncated[0, row])
        if rows is not None:
            rows.append(Row(obs, action, float(raw.reward[0, row])))
            if len(rows) == self._wanted.length or raw.terminated[0, row]:
                self._finish(row, rows)
        if ended or self._age[row] % self._wanted.length == 0:
            self._rows[row] = None
            self._frames[row].clear()
        if ended:
            self._age[row] = 0

    def _finish(self, row: int, rows: list[Row]) -> None:
        if len(self._found) < self._wanted.clips:
            if self._films is not None:
                fps = int(self._made[row].metadata.get("render_fps") or _FPS)
                write_film(self._frames[row], self._films / f"{self._name_of(len(self._found))}.mp4", fps)
            self._found.append(segment(rows, self._wanted.length))


def _small(frame: np.ndarray) -> np.ndarray:
    step = -(-max(frame.shape[:2]) // _WIDEST)
    return frame[::step, ::step].copy()
