"""Whether the same seed gives the same game: again, in a second environment, beside another one; and whether seeds matter at all."""

from collections.abc import Callable
from typing import TypeAlias

import gymnasium
import numpy as np

from thorndike.environments.checking.findings import Findings
from thorndike.environments.checking.observations import WHOLE_BYTES, leaf_key
from thorndike.environments.checking.play import Outcome, Player, Sampler, close
from thorndike.environments.checking.recording import Recording
from thorndike.errors import UserError

BESIDE_ROWS = 300
"""Rows replayed beside another environment: what is shared shows within a few."""
SIGNATURE_STEPS = 100
SEEDS = 5

_FROM_SEED = "draw everything random from self.np_random, after super().reset(seed=seed)"

Difference: TypeAlias = tuple[int, str]
"""The first step that differs (0: the first observation), and how."""


def check_repeats(player: Player, make: Callable[[], gymnasium.Env], recording: Recording, findings: Findings) -> None:
    """Replays the recording; reports the first way in which it cannot be repeated. Raises CannotGoOn as playing does."""
    again = _retrace(player, recording)
    try:
        second = Player(make(), findings)
    except UserError as error:
        findings.hint(
            "single_instance", f"a second environment cannot be made beside the first: {error}", "train with --num-envs 1 --seeds 1"
        )
        if again is not None:
            _report_again(again, recording.seed, findings)
        return
    try:
        _check_second(player, second, again, recording, findings)
    finally:
        close(second.environment, findings)


def _check_second(player: Player, second: Player, again: Difference | None, recording: Recording, findings: Findings) -> None:
    """What a second environment tells, given how the first one, played again, differed."""
    fresh = _retrace(second, recording)
    if again is not None and fresh is not None:
        _report_again(again, recording.seed, findings)
    elif again is not None:
        findings.error(
            "reset_incomplete",
            f"a new environment repeats the game, a used one, reset, differs at {_at(again[0], recording.seed)}: {again[1]}",
            "set every attribute anew in reset, and build a simulation anew; else an exact resume is not possible",
        )
    elif fresh is not None:
        findings.error(
            "determinism",
            f"a second environment differs from the first at {_at(fresh[0], recording.seed)}: {fresh[1]}",
            "draw what is random in reset from self.np_random, not in __init__ or when the module is imported",
        )
    else:
        _check_beside(player, second, recording, findings)


def _check_beside(player: Player, second: Player, recording: Recording, findings: Findings) -> None:
    """Whether playing one environment changes what another does."""
    sampler = Sampler(player.environment.action_space, recording.seed + 1)
    last = player.reset(recording.seed + 1)

    def disturb() -> None:
        nonlocal last
        last = player.reset() if last.ended else player.step(sampler.draw(last.mask))

    difference = _retrace(second, recording, BESIDE_ROWS, disturb)
    if difference is not None:
        findings.error(
            "shared_state",
            f"two environments in one process disturb each other: with the other played, one differs at "
            f"{_at(difference[0], recording.seed)}: {difference[1]}",
            "keep all state in self: no np.random or random of the module, no class attribute that changes",
        )


def _report_again(again: Difference, seed: int, findings: Findings) -> None:
    findings.error(
        "seeding" if again[0] == 0 else "determinism", f"the same seed and actions differ at {_at(again[0], seed)}: {again[1]}", _FROM_SEED
    )


def _at(step: int, seed: int) -> str:
    return f"step {step:,} after reset(seed={seed})" if step else f"the first observation of reset(seed={seed})"


def check_seeds(player: Player, recording: Recording, findings: Findings) -> None:
    """Different seeds should play differently, and so should the episodes after one seed. Raises CannotGoOn as playing does."""
    seeds = range(recording.seed + 1, recording.seed + 1 + SEEDS)
    from_seeds = {_signature(player, seed) for seed in seeds}
    unseeded = {_signature(player, None) for _ in range(SEEDS)}
    # Between one and nearly all there is an environment that seldom draws anything, which is in order.
    if len(from_seeds) == 1 and len(unseeded) == 1:
        findings.hint(
            "seed_has_no_effect",
            f"with the same actions, {SEEDS} seeds and {SEEDS} resets without one played the same {SIGNATURE_STEPS} steps: it never varies",
            "nothing, if that is meant; else draw what should vary from self.np_random (seeds then differ in the learner's luck alone)",
        )
    elif len(from_seeds) == 1 and len(unseeded) >= SEEDS - 1:
        findings.error(
            "seeding",
            f"{SEEDS} seeds played the same {SIGNATURE_STEPS} steps, but resets without a seed vary: seed is not used",
            _FROM_SEED,
        )
    elif len(unseeded) == 1 and len(from_seeds) >= SEEDS - 1:
        findings.warning(
            "reset_repeats",
            f"{SEEDS} resets without a seed played the same {SIGNATURE_STEPS} steps, though different seeds play different ones",
            "make the generator anew only where a seed is given: super().reset(seed=seed) does; then draw from self.np_random",
        )


def _signature(player: Player, seed: int | None) -> int:
    """One number for the steps after a reset, always with the same actions."""
    sampler = Sampler(player.environment.action_space, 0)
    outcome = player.reset(seed)
    played: list[object] = [outcome.key]
    for _ in range(SIGNATURE_STEPS):
        outcome = player.reset() if outcome.ended else player.step(sampler.draw(outcome.mask))
        played.append((outcome.key, str(outcome.reward), outcome.ended))
    return hash(tuple(played))


def _retrace(player: Player, recording: Recording, rows: int | None = None, between: Callable[[], None] | None = None) -> Difference | None:
    """Play the recording once more: the first step at which it differs, and how."""
    step = 0
    for number, row in enumerate(recording.rows[:rows]):
        if between is not None:
            between()
        if row.is_step:
            step += 1
            outcome = player.step(row.action)
        else:
            outcome = player.reset(recording.seed if number == 0 else None)
        difference = describe_difference(row.outcome, outcome)
        if difference is not None:
            return step, difference
    return None


def describe_difference(first: Outcome, second: Outcome) -> str | None:
    """How two outcomes differ, in words with numbers; None if they do not."""
    for leaf, old in zip(second.leaves, first.key, strict=True):
        if leaf_key(leaf.array) == old:
            continue
        if leaf.array.nbytes > WHOLE_BYTES:
            return f"{leaf.path} differs"
        before = np.frombuffer(old, leaf.array.dtype).reshape(leaf.array.shape).astype(np.float64)
        index = np.unravel_index(int(np.argmax(np.abs(before - leaf.array))), before.shape)
        where = f"{leaf.path}[{', '.join(map(str, map(int, index)))}]" if index else leaf.path
        return f"{where} was {before[index]:.6g}, then {float(leaf.array[index]):.6g}"
    for name in ("reward", "terminated", "truncated"):
        was, now = getattr(first, name), getattr(second, name)
        if was != now and not (was != was and now != now):
            return f"{name} was {was}, then {now}"
    return None
