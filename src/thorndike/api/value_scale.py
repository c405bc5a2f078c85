"""Whether what a learner calls a value is counted in the environment's own rewards, so that it can be held against returns."""

from typing import cast

from thorndike.training.json_files import Json

KEEP_REWARDS = ("discretise", "normalize_observation", "frame_stack", "select_observation")
"""Wrappers that leave rewards as they are. Any other one is taken to change them."""


def incomparable_values(facts: Json) -> str | None:
    """Why a policy's values (``facts`` is its ``policy.json``) are on another scale; None if they are on that of rewards.

    SAC's and its relatives' count the entropy bonus to come too; that is part of what they are off by.
    """
    changing = [wrapper.get("name", "one of your own") for wrapper in cast(list[Json], facts["wrappers"])]
    changing = [name for name in changing if name not in KEEP_REWARDS]
    config = cast(Json, facts["config"])
    if changing:
        return f"its values are of rewards that a wrapper changed ({', '.join(map(str, changing))})"
    if not isinstance(config.get("gamma"), int | float):
        return "it learns no discounted values"
    if config.get("munchausen"):
        return "its values count the log-policy too (munchausen)"
    if config.get("baseline") is False:
        return "it learns no value (baseline=false)"
    return None
