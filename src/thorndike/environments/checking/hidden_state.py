"""Whether the observation tells enough: the same observation and action should lead to the same, unless something is drawn at random.

Two tests, both for environments that draw nothing while they are stepped:

* exact: an observation and an action that came more than once, with different rewards or successors;
* for small Box observations, which never come twice: if the change of a dimension can hardly be told from observation and action, but
  well from them and the step before, then something like a velocity is hidden. Told by the better of a linear fit and nearest
  neighbours, on one step in five that they have not seen, so that a state which is complete but not linear raises no alarm. Measured on
  two seeds: with velocities hidden, CartPole 0.34 to 0.59 without the step before and 1.00 with it, MountainCar 0.01 and 1.00, Pendulum
  0.04 and 0.96; of 13 complete environments none went from below 0.6 to above 0.9.
"""

import random
from collections import defaultdict
from collections.abc import Iterator

import gymnasium
import numpy as np

from thorndike.environments.checking.findings import Findings
from thorndike.environments.checking.observations import Key
from thorndike.environments.checking.play import Action, Player, Sampler
from thorndike.environments.checking.recording import Recording

LONGEST_PREFIX = 40
SITUATIONS = 12
STEPS_AFTER = 5
NEIGHBOURS = 5
HARDLY, WELL = 0.6, 0.9
"""Shares of a change's variance that are explained without and with the step before."""
ROUNDING = 1e-4
"""Differences below this share are taken for rounding: an environment that computes in float64 may show float32."""
FEWEST_TRANSITIONS, MOST_TRANSITIONS = 200, 2_000

_FIX = "show what is hidden in the observation; else td.wrappers.frame_stack(4), or a memory: --set memory=gru"


def check_hidden_state(player: Player, recording: Recording, findings: Findings) -> None:
    """Both tests; neither says anything of an environment that draws random numbers. Raises CannotGoOn as playing does."""
    seen_twice, contradicted, example = _contradictions(recording)
    unexplained = [] if contradicted else _unexplained(recording)
    if not (contradicted or unexplained) or is_random(player, recording.seed):
        return
    if contradicted:
        message = (
            f"the same observation and action led to different {example} in {contradicted} of {seen_twice} cases that came more than once, "
            "and its random generators make no difference"
        )
    else:
        listed = ", ".join(f"{name} ({without:.0%}, with it {with_it:.0%})" for name, without, with_it in unexplained[:4])
        message = f"how the observation changes can hardly be told without the step before; share explained: {listed}"
    findings.hint("hidden_state", message, _FIX)


def is_random(player: Player, seed: int) -> bool:
    """Whether a step depends on the random generators: played twice from the same points, with the generators moved on in between."""
    for situation in range(SITUATIONS):
        calm, moved = (_play_after(player, seed + situation, situation, shake=shake) for shake in (False, True))
        if calm != moved:
            return True
    return False


def _play_after(player: Player, seed: int, situation: int, *, shake: bool) -> list[tuple[Key, str]]:
    """A few steps after a random prefix; the generators moved on before them, if asked for."""
    sampler = Sampler(player.environment.action_space, seed)
    outcome = player.reset(seed)
    for _ in range(situation * LONGEST_PREFIX // SITUATIONS):
        outcome = player.reset() if outcome.ended else player.step(sampler.draw(outcome.mask))
    if outcome.ended:
        outcome = player.reset()
    for generator in _generators(player.environment) if shake else ():
        generator.random()
    played = []
    for _ in range(STEPS_AFTER):
        if outcome.ended:
            break
        outcome = player.step(sampler.draw(outcome.mask))
        played.append((outcome.key, str(outcome.reward)))
    return played


def _generators(environment: gymnasium.Env) -> Iterator[np.random.Generator | np.random.RandomState | random.Random]:
    """The random generators that the environment and its wrappers hold, themselves or in their parts."""
    yield from _held(environment, depth=1)
    while isinstance(environment, gymnasium.Wrapper):
        environment = environment.env
        yield from _held(environment, depth=1)


def _held(owner: object, depth: int) -> Iterator[np.random.Generator | np.random.RandomState | random.Random]:
    for value in vars(owner).values():
        if isinstance(value, np.random.Generator | np.random.RandomState | random.Random):
            yield value
        elif depth and hasattr(value, "__dict__") and not isinstance(value, type | gymnasium.Env | gymnasium.Space):
            yield from _held(value, depth - 1)


def _contradictions(recording: Recording) -> tuple[int, int, str]:
    """How many pairs of observation and action came more than once, how many of them contradict themselves, and in what."""
    places: dict[tuple[Key, bytes], list[int]] = defaultdict(list)
    for place in range(1, len(recording.rows)):
        row = recording.rows[place]
        if row.is_step:
            places[recording.rows[place - 1].outcome.key, np.asarray(row.action).tobytes()].append(place)
    repeated = [found for found in places.values() if len(found) > 1]
    scale = np.abs(recording.rewards).max(initial=0)
    by_reward = [np.ptp([recording.rows[place].outcome.reward for place in found]) > ROUNDING * scale for found in repeated]
    by_successor = [_successors_differ(recording, found) for found in repeated]
    what = "rewards and successors" if any(by_reward) and any(by_successor) else "rewards" if any(by_reward) else "successors"
    return len(repeated), int(np.logical_or(by_reward, by_successor).sum()), what


def _successors_differ(recording: Recording, places: list[int]) -> bool:
    """Whether the observations at these places differ by more than rounding."""
    if len({recording.rows[place].outcome.key for place in places}) == 1:
        return False
    if len(recording.vectors) != len(recording.rows):
        return True
    found = np.array([recording.vectors[place] for place in places])
    return bool((np.ptp(found, axis=0) > ROUNDING * np.abs(found).max(axis=0)).any())


def _unexplained(recording: Recording) -> list[tuple[str, float, float]]:
    """The dimensions whose change the step before explains and the observation does not: name, share explained without, and with."""
    table = _transitions(recording)
    if table is None:
        return []
    now, action, before, change = table
    without, with_it = np.concatenate([now, action], axis=1), np.concatenate([now, action, before], axis=1)
    names = [f"{leaf.path}[{i}]" for leaf in recording.ranges.values() for i in range(leaf.low.size)]
    found = []
    for dimension in np.flatnonzero(change.std(axis=0) > 1e-9):
        target = change[:, dimension]
        known = _explained(without, target)
        if known < HARDLY and (better := _explained(with_it, target)) > WELL:
            found.append((names[dimension], max(known, 0.0), better))
    return found


def _transitions(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Observation, action, the step before (change and action), the change: a row for each step that has one before it, or None if few."""
    if len(recording.vectors) != len(recording.rows):
        return None
    rows = [i for i in range(2, len(recording.rows)) if recording.rows[i].is_step and recording.rows[i - 1].is_step]
    if len(rows) < FEWEST_TRANSITIONS:
        return None
    obs, at = np.array(recording.vectors), np.array(rows[:MOST_TRANSITIONS])
    action, action_before = (_as_features([recording.rows[i].action for i in when]) for when in (at, at - 1))
    return obs[at - 1], action, np.concatenate([obs[at - 1] - obs[at - 2], action_before], axis=1), obs[at] - obs[at - 1]


def _as_features(actions: list[Action]) -> np.ndarray:
    """Actions as rows of numbers: whole ones one-hot."""
    rows = np.array(actions).reshape(len(actions), -1)
    if rows.dtype.kind == "f":
        return rows.astype(np.float64)
    return np.concatenate([rows[:, [k]] == np.unique(rows[:, k]) for k in range(rows.shape[1])], axis=1).astype(np.float64)


def _explained(features: np.ndarray, target: np.ndarray) -> float:
    """The share of the target's variance that the better of two fits explains on the rows left out."""
    spread = features.std(axis=0)
    scaled = (features - features.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    left_out = np.arange(len(target)) % 5 == 0
    known, asked = scaled[~left_out], scaled[left_out]
    design = np.concatenate([known, np.ones((len(known), 1))], axis=1)
    weights = np.linalg.lstsq(design, target[~left_out], rcond=None)[0]
    linear = np.concatenate([asked, np.ones((len(asked), 1))], axis=1) @ weights
    distances = np.square(asked[:, None] - known[None]).sum(axis=2)
    nearest = np.argpartition(distances, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
    truth = target[left_out]
    errors = [np.square(guess - truth).mean() for guess in (linear, target[~left_out][nearest].mean(axis=1))]
    return float(1 - min(errors) / max(truth.var(), 1e-12))
