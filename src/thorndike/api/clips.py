"""Clips of behaviour by hand: record pairs, let a program judge them, learn a reward from what was chosen."""

import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thorndike import startup
from thorndike.api.building import EnvironmentLike
from thorndike.api.loading import LoadedPolicy, bounded, load
from thorndike.clips import choices as judging
from thorndike.clips.actors import Agent, AtRandom, Performer
from thorndike.clips.collecting import Wanted, collect
from thorndike.clips.folder import (
    FILMS,
    About,
    Collection,
    add_collection,
    all_segments,
    begin_folder,
    clip_name,
    number_of_collections,
    read_about,
)
from thorndike.clips.queries import pairs_to_ask
from thorndike.clips.reward_files import load_reward, newest_reward, read_reward, write_reward
from thorndike.clips.reward_fitting import Report, config_of, fit_reward, predicted_returns
from thorndike.clips.segments import Segments
from thorndike.environments import registry
from thorndike.environments.host.action_masks import mask_in_observation
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.errors import UserError
from thorndike.networks.masking import has_mask
from thorndike.training.space_files import space_to_json
from thorndike.user_code import lasting_name

QUESTION = "Which of the two does better what you want?"
LENGTH, PAIRS = 25, 50
_FRESH, _CHOSEN = 2, 4
"""Clips that are recorded for each pair; more of them where an ensemble says which pairs to ask."""
_POOL, _FILMED_POOL = 20, 4
"""Environments side by side; each that is filmed has a picture to draw."""


class Recorded(NamedTuple):
    """What a collection added."""

    folder: Path
    collection: int
    pairs: int
    made_by: str
    chosen_by: str
    """``chance``, or the ``disagreement`` of an ensemble."""


class Fitted(NamedTuple):
    """A reward that was learnt."""

    reward: Path
    report: Report


def collect_clips(
    environment: EnvironmentLike,
    to: str | Path,
    *,
    pairs: int = PAIRS,
    run: str | Path | LoadedPolicy | None = None,
    length: int = LENGTH,
    question: str = QUESTION,
    films: bool = True,
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
    seed: int = 0,
) -> Recorded:
    """Record clips of ``length`` steps in the folder ``to`` and ask for choices between ``pairs`` of them.

    A trained ``run`` acts as it does while it learns; without one actions are random. Which pairs are asked is decided by chance, or once a
    reward has been learnt there, by how much its members disagree. Raises ``UserError`` for what cannot be recorded or filmed.
    """
    where = Path(to)
    if pairs < 1 or length < 1 or not 0 <= seed < 2**32:
        raise UserError(f"record at least one pair of clips of at least one step; got pairs={pairs}, length={length}, seed={seed}")
    startup.choose_device("auto", False)
    choice = bounded(registry.resolve(environment, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps))
    loaded = None if run is None else run if isinstance(run, LoadedPolicy) else load(run)
    if loaded is not None and loaded.facts["environment"] != lasting_name(choice.id):
        raise UserError(f"{loaded.run} was trained on {loaded.facts['environment']}, not on {choice.id}")
    begin_folder(where, _about(choice, max_episode_steps, length, question))
    number = number_of_collections(where)
    learnt = newest_reward(where)
    clips = pairs * (_FRESH if learnt is None else _CHOSEN)
    wanted = Wanted(max(2, clips), length, min(clips, _FILMED_POOL if films else _POOL), seed, number)
    drawn = where / FILMS / f"partial-{number}"
    shutil.rmtree(drawn, ignore_errors=True)
    found = _record(choice, loaded, wanted, drawn if films else None)
    dice, sums = np.random.default_rng([seed, number]), None
    if learnt is not None:
        stored = read_reward(learnt)
        sums = predicted_returns(load_reward(stored), found, stored.net_arch)
    chosen = pairs_to_ask(found.number, pairs, dice, sums)
    used, renumbered = np.unique(chosen, return_inverse=True)
    made_by = "random actions" if loaded is None else str(loaded.run)
    kept = [(int(first), int(second)) for first, second in renumbered.reshape(-1, 2)]
    if films:
        for place, before in enumerate(used):
            (drawn / f"{before}.mp4").replace(where / FILMS / f"{clip_name(number, place)}.mp4")
        shutil.rmtree(drawn, ignore_errors=True)
    collection = Collection(number, found.take(used), kept, made_by, films)
    add_collection(where, collection)
    judging.ask(where, collection)
    return Recorded(where, number, len(kept), made_by, "chance" if sums is None or len(sums) < 2 else "disagreement")


def judge_clips(where: str | Path, *, temperature: float = 1.0, error_rate: float = 0.0, seed: int = 0) -> int:
    """Let a program judge all pairs that nobody has judged, by the environment's own rewards; how many judgements that made.

    It chooses by Bradley-Terry on the clips' returns over ``temperature`` (0: always the better one), and at random in a share
    ``error_rate`` of cases. Raises ``UserError`` for a folder of something else.
    """
    if not (temperature >= 0 and 0 <= error_rate <= 1):
        raise UserError(f"a temperature is at least 0 and an error rate a share, 0 to 1; got {temperature} and {error_rate}")
    read_about(Path(where))
    return judging.simulate(Path(where), temperature, error_rate, seed)


def fit_clips(where: str | Path, *, settings: Mapping[str, object] | None = None, seed: int = 0) -> Fitted:
    """Learn a reward from all choices in a folder; it is kept there beside those before it. Raises ``UserError`` for too few choices."""
    where = Path(where)
    startup.choose_device("auto", False)
    about, config = read_about(where), config_of(settings or {})
    segments, spaces = all_segments(where), about.spaces
    held, report = fit_reward(segments, judging.read_choices(where), spaces, config, seed)
    return Fitted(write_reward(where, held, tuple(config.net_arch), about.environment, spaces, report), report)


def _about(choice: registry.Choice, limit: int | None, length: int, question: str) -> About:
    probe = registry.reference(choice)
    spaces = space_to_json(probe.observation_space), space_to_json(probe.action_space)
    probe.close()
    return About(lasting_name(choice.id), dict(choice.env_kwargs), limit, *spaces, length, question)


def _record(choice: registry.Choice, loaded: LoadedPolicy | None, wanted: Wanted, films: Path | None) -> Segments:
    make = partial(registry.reference, choice, **({} if films is None else {"render_mode": "rgb_array"}))
    masked = loaded is None or has_mask(loaded.policy.spec.observation_space)

    def perform(engine: LoopEngine) -> Performer:
        if loaded is None:
            return AtRandom(engine.spec.action_space, wanted.num_envs, (wanted.seed, wanted.number))
        return Agent(loaded.policy, wanted.num_envs, (wanted.seed, wanted.number))

    if films is not None:
        films.mkdir(parents=True)
    return collect(wanted, mask_in_observation(make) if masked else make, choice.id, perform, films, str)
