"""What a recording tells of itself: how episodes end, what rewards are worth, how large observations are and whether they change."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from gymnasium import spaces

from thorndike.environments.checking.findings import Findings
from thorndike.environments.checking.recording import Episode, Range, Recording

LARGE_REWARD = 1_000.0
SMALL_REWARD = 0.01
LARGE_OBSERVATION = 30.0
"""Root mean square above which a network learns slowly. Pendulum's angular velocity has 4, MuJoCo's contact forces hundreds."""
SHORTEST_LIMIT = 10
"""Episodes that all end after fewer steps are more likely made so than cut off."""
FEW_STEPS = 100
LARGE_LEAF = 1_000
"""In leaves of more numbers, and in images, single ones may well stay the same."""


def check_ends(episodes: Sequence[Episode], played: int, limit: int | None, findings: Findings) -> None:
    """``terminated`` and ``truncated``: that something ends an episode, and that the two are not merged, swapped or confused."""
    if not episodes:
        if limit is None:
            findings.warning(
                "never_ends",
                f"no episode ended in {played:,} steps with random actions, and no time limit is registered",
                "set one: --max-episode-steps 500, or max_episode_steps where it is registered",
            )
        return
    cut = [episode.length for episode in episodes if episode.truncated]
    dead = [episode.length for episode in episodes if episode.terminated]
    if len(cut) >= 2 and all(episode.terminated for episode in episodes if episode.truncated):
        findings.warning(
            "ends_merged",
            f"terminated was also set in all {len(cut)} episodes that were truncated: they look like one flag returned twice",
            "terminated: the task is over, its future is worth 0; truncated: only the clock ran out. Set each by its own condition",
        )
    elif len(set(cut)) >= 3 and len(cut) >= 5 and len(set(dead)) <= 1 and max(cut) < max(dead, default=np.inf):
        where = f"terminated only at {dead[0]} steps" if dead else "none was terminated"
        findings.warning(
            "ends_swapped",
            f"{len(cut)} episodes were truncated at many lengths, from {min(cut)} to {max(cut)} steps, and {where}",
            "if the task is over there, return terminated=True; truncated is for time limits. Perhaps the two are swapped",
        )
    else:
        _check_limit_as_end(dead, findings)


def _check_limit_as_end(dead: Sequence[int], findings: Findings) -> None:
    """Whether ``terminated`` comes again and again at one length that no episode exceeds."""
    longest = max(dead, default=0)
    times = Counter(dead)[longest]
    if longest < 2 or times < 3 or times < 0.2 * len(dead) or (longest < SHORTEST_LIMIT and times < len(dead)):
        return
    report = findings.warning if longest >= SHORTEST_LIMIT else findings.hint
    report(
        "time_limit_as_termination",
        f"{times} of {len(dead)} episodes were terminated after exactly {longest} steps, and none later: that looks like a time limit",
        "if only the clock ran out there, return truncated=True and terminated=False, or leave the limit to max_episode_steps",
    )


def check_rewards(recording: Recording, findings: Findings) -> None:
    """That rewards vary, and are neither huge nor tiny."""
    rewards = recording.rewards
    rewards = rewards[np.isfinite(rewards)]
    if len(rewards) < FEW_STEPS:
        return
    largest = float(np.abs(rewards).max())
    lengths = {episode.length for episode in recording.episodes if episode.terminated}
    # Where episodes end at different lengths, a constant reward tells them apart, as in CartPole.
    if np.ptp(rewards) == 0 and len(lengths) <= 1:
        findings.hint(
            "reward_constant",
            f"the reward was {rewards[0]:.6g} at each of {len(rewards):,} steps with random actions: nothing tells good ones from bad",
            "if a rare goal pays, help the learner find it (td.wrappers.potential_shaping, longer exploration); else mend the reward",
        )
    if largest >= LARGE_REWARD or 0 < largest <= SMALL_REWARD:
        findings.warning(
            "reward_scale",
            f"the largest reward in {len(rewards):,} steps was {largest:.3g} in size (mean {rewards.mean():.3g})",
            "bring rewards to about 1: divide them, or use td.wrappers.normalize_reward(gamma)",
        )


def check_ranges(recording: Recording, findings: Findings) -> None:
    """That observations change, and are not so large that a network learns slowly."""
    if recording.steps < FEW_STEPS:
        return
    for known in recording.ranges.values():
        _check_constant(known, recording.steps, findings)
        _check_size(known, findings)


def _check_constant(known: Range, steps: int, findings: Findings) -> None:
    still = np.flatnonzero(np.ravel(known.low == known.high))
    size = known.low.size
    if len(still) == 0 or ((size > LARGE_LEAF or known.low.ndim > 1) and len(still) < size):
        return
    number = "dimension" if len(still) == 1 else "dimensions"
    which = "" if size == 1 else " as a whole" if len(still) == size else f": {number} {_some(still)}"
    findings.hint(
        "observation_constant",
        f"{known.path}{which} never changed in {steps:,} steps (it is {np.ravel(known.low)[still[0]]:.6g})",
        "leave it out, or mend it if it should change",
        known.path,
    )


def _check_size(known: Range, findings: Findings) -> None:
    if not isinstance(known.space, spaces.Box) or known.space.dtype == np.uint8:
        return
    sizes = np.ravel(known.root_mean_square)
    largest = int(np.argmax(sizes))
    if sizes[largest] > LARGE_OBSERVATION:
        where = f"{known.path}[{largest}]" if known.low.ndim == 1 else known.path
        findings.hint(
            "observation_scale",
            f"{where} is about {sizes[largest]:.3g} in size ({np.min(known.low):.4g} to {np.max(known.high):.4g} over all)",
            "bring observations to about 1: td.wrappers.normalize_observation(), or scale them (images: np.uint8 in 0 to 255)",
            known.path,
        )


def _some(numbers: np.ndarray) -> str:
    shown = ", ".join(map(str, numbers[:8].tolist()))
    return shown if len(numbers) <= 8 else f"{shown}, ... ({len(numbers)} in all)"
