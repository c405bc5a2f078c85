"""``check-env``: what is wrong with an environment, told before anything is trained in it. Free of JAX.

It is played, as Gymnasium gives it, with random actions from a seed; the game is then repeated in several ways. Each finding says what,
where and with which numbers, and how to mend it. What an error makes pointless is not looked at, and the report says so.
"""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import CannotGoOn, Finding, Findings
from thorndike.environments.checking.hidden_state import check_hidden_state
from thorndike.environments.checking.idle_actions import check_idle_actions
from thorndike.environments.checking.play import Action, Player, Sampler, check_signatures, close
from thorndike.environments.checking.recorded import check_ends, check_ranges, check_rewards
from thorndike.environments.checking.recording import Recording, play_on, record
from thorndike.environments.checking.repeats import check_repeats, check_seeds, describe_difference
from thorndike.environments.checking.spaces import check_spaces
from thorndike.environments.origins import limit_of

ENOUGH_EPISODES = 12
"""Ends are judged by so many episodes, or by as many as end in twice the steps more."""
IDLE_SHARE = 10
"""The search for idle actions may take so many times the steps; it ends as soon as all are told apart."""
LONG_EPISODE = 1_000
"""An environment may cut its episodes itself; so long they may be."""
REFUSALS = (gymnasium.error.Error, RuntimeError, AssertionError, ValueError)
"""What an environment raises on purpose where it is stepped after its end."""


class Game(NamedTuple):
    """What the checks share."""

    make: Callable[[], gymnasium.Env]
    player: Player
    recording: Recording
    steps: int
    findings: Findings

    @property
    def environment(self) -> gymnasium.Env:
        """The first environment made."""
        return self.player.environment


class Report(NamedTuple):
    """What was found, and what was looked at."""

    findings: list[Finding]
    """Errors first, then warnings, then hints."""
    steps: int
    """Steps with random actions that were recorded."""
    episodes: int
    """Episodes that ended in them."""
    checked: list[str]
    """Those of ``CHECKS`` that were begun."""
    not_checked: list[str]
    """The others: an error before made them pointless."""


def check(make: Callable[[], gymnasium.Env], steps: int = 1000, seed: int = 0) -> Report:
    """Play environments that ``make`` gives, and say what is wrong with them.

    ``steps`` are recorded and repeated; all checks together take 5 to 25 times as many. Raises what ``make`` raises the first time.
    """
    findings, recording = Findings(), Recording(seed)
    game = Game(make, Player(make(), findings), recording, steps, findings)
    begun: list[str] = []
    passed: set[str] = set()
    for name, (run, needs) in CHECKS.items():
        if needs is not None and needs not in passed:
            continue
        begun.append(name)
        with contextlib.suppress(CannotGoOn):
            run(game)
            passed.add(name)
    left_out = [name for name in CHECKS if name not in begun]
    return Report(findings.listed(), recording.steps, len(recording.episodes), begun, left_out)


def _spaces(game: Game) -> None:
    check_spaces(game.environment, game.findings)


def _play(game: Game) -> None:
    check_signatures(game.environment, game.findings)
    record(game.player, game.recording, Sampler(game.environment.action_space, game.recording.seed), game.steps)
    game.findings.counting = False


def _rewards(game: Game) -> None:
    check_rewards(game.recording, game.findings)


def _ranges(game: Game) -> None:
    check_ranges(game.recording, game.findings)


def _repeats(game: Game) -> None:
    check_repeats(game.player, game.make, game.recording, game.findings)
    if game.findings.has("seeding", "determinism", "shared_state", "reset_incomplete"):
        raise CannotGoOn


def _seeds(game: Game) -> None:
    check_seeds(game.player, game.recording, game.findings)


def _ends(game: Game) -> None:
    limit, episodes = limit_of(game.environment), list(game.recording.episodes)
    sampler = Sampler(game.environment.action_space, game.recording.seed + 1)
    more = play_on(game.player, sampler, episodes, ENOUGH_EPISODES, 2 * game.steps)
    check_ends(episodes, game.recording.steps + more, limit, game.findings)
    if limit is None and episodes:
        _check_stubborn_policies(game)


def _check_stubborn_policies(game: Game) -> None:
    """Without a time limit a policy that does the same for ever must end too: random actions end what a learner need not."""
    most = max(game.steps, LONG_EPISODE)
    for action in _constant_actions(game.environment.action_space):
        outcome = game.player.reset(game.recording.seed)
        for _ in range(most):
            # What is masked must not be done, and whoever masks has its own idea of what goes on.
            if outcome.ended or outcome.mask is not None:
                break
            outcome = game.player.step(action)
        if not outcome.ended and outcome.mask is None:
            game.findings.hint(
                "no_time_limit",
                f"with action {action} alone an episode goes on for more than {most:,} steps, and no time limit is registered",
                "set one: --max-episode-steps 500, or max_episode_steps where it is registered",
            )
            return


def _constant_actions(space: gymnasium.Space) -> Iterator[Action]:
    match space:
        case spaces.Discrete():
            yield from (np.int64(space.start + number) for number in range(min(int(space.n), 4)))
        case spaces.Box() if space.is_bounded():
            yield from (space.low.copy(), space.high.copy())


def _after_an_end(game: Game) -> None:
    """A step too many may be refused or do nothing, but must not break what a reset gives."""
    player, seed = game.player, game.recording.seed
    sampler = Sampler(game.environment.action_space, seed)
    outcome = player.reset(seed)
    for _ in range(game.steps):
        if outcome.ended:
            break
        outcome = player.step(sampler.draw(outcome.mask))
    if not outcome.ended:
        return
    try:
        with contextlib.suppress(*REFUSALS), warnings.catch_warnings(action="ignore"):
            game.environment.step(sampler.draw())
    except Exception as error:
        game.findings.hint(
            "step_after_end",
            f"a step after an end, without a reset, raised {type(error).__name__}: {error}",
            "nothing here does that; to help others, raise gymnasium.error.ResetNeeded there",
        )
    difference = describe_difference(game.recording.rows[0].outcome, player.reset(seed))
    if difference is not None:
        game.findings.error(
            "reset_incomplete",
            f"after one step too many, reset(seed={seed}) starts elsewhere: {difference}",
            "set every attribute anew in reset",
        )


def _idle_actions(game: Game) -> None:
    check_idle_actions(game.player, game.recording.seed, IDLE_SHARE * game.steps, game.findings)


def _hidden_state(game: Game) -> None:
    # What is not seen, or not a number, tells nothing of what is hidden.
    if not game.findings.has("unsupported_space", "observation_not_finite", "reward_not_finite"):
        check_hidden_state(game.player, game.recording, game.findings)


def _close(game: Game) -> None:
    close(game.environment, game.findings)


class Check(NamedTuple):
    """What is looked at, and which check must have passed before."""

    run: Callable[[Game], None]
    needs: str | None


CHECKS = {
    "spaces": Check(_spaces, None),
    "returned values": Check(_play, "spaces"),
    "rewards": Check(_rewards, "spaces"),
    "ranges of observations": Check(_ranges, "spaces"),
    "repeating from a seed": Check(_repeats, "returned values"),
    "different seeds": Check(_seeds, "repeating from a seed"),
    "ends and time limits": Check(_ends, "returned values"),
    "steps after an end": Check(_after_an_end, "repeating from a seed"),
    "idle actions": Check(_idle_actions, "repeating from a seed"),
    "hidden state": Check(_hidden_state, "repeating from a seed"),
    "closing": Check(_close, None),
}
"""Everything that is looked at, in order, by the names a report uses."""
