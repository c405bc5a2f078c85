"""A learnt reward put into a run: when it begins, and when it goes on with another that more choices have told."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp

from thorndike.api.building import Job
from thorndike.clips.reward_files import StoredReward, load_reward, read_reward
from thorndike.environments.learned_reward import NAME, LearnedReward, learned_reward
from thorndike.environments.wrappers import build_wrapper
from thorndike.errors import UserError
from thorndike.training.json_files import Json
from thorndike.training.segment import Carry
from thorndike.types import Wrapper


def as_recorded(stored: StoredReward) -> dict[str, str]:
    """What ``run.json`` keeps of a reward."""
    return {"path": str(stored.path), "sha256": stored.sha256}


def check_fits(stored: StoredReward, environment: str) -> None:
    """Raises ``UserError`` for a reward that was learnt from clips of another environment."""
    if stored.environment != environment:
        raise UserError(f"the reward in {stored.path} was learnt from clips of {stored.environment}, not of {environment}")


def recorded_reward(recorded: Mapping[str, str]) -> StoredReward:
    """The reward that a run began with. Raises ``UserError`` if it is not what it was."""
    stored = read_reward(recorded["path"])
    if stored.sha256 != recorded["sha256"]:
        raise UserError(f"{stored.path} was changed since the run began; put it back, or train a new run on it")
    return stored


def with_reward(carry: Carry, job: Job, stored: StoredReward) -> Carry:
    """The same carry, its agents learning from this reward from now on. Raises ``UserError`` where it has another size."""
    names = [wrapper.get("name") for wrapper in job.request.wrappers]
    place, statistics = names.index(NAME), list(carry.source.statistics)
    before = cast(LearnedReward, statistics[place])
    held = load_reward(stored)
    wanted, found = (jax.tree.map(jnp.shape, tree) for tree in (jax.tree.map(lambda x: x[0], before), held))
    if wanted != found:
        raise UserError(f"the reward in {stored.path} has another size, or is of other observations, than the one this run began with")
    seeds = job.request.seeds
    statistics[place] = jax.tree.map(lambda x: jnp.array(jnp.broadcast_to(x, (seeds, *jnp.shape(x)))), held)
    return carry._replace(source=carry.source._replace(statistics=tuple(statistics)))


def with_change(record: Json, stored: StoredReward, step: int) -> Json:
    """The record of a run, with the reward that it goes on with from a step."""
    changes = list(cast(list[Json], record.get("rewards") or []))
    now = as_recorded(stored)
    last = changes[-1] if changes else {**cast(Json, record["reward"]), "step": 0}
    if last["sha256"] == now["sha256"]:
        return record
    return {**record, "rewards": [*changes, {"step": step, **now}]}


def first_change(record: Json) -> int | None:
    """The step from which a run's reward is another than the one it began with."""
    changes = cast(list[Json], record.get("rewards") or [])
    return cast(int, changes[0]["step"]) if changes else None


def begun_with(
    reward: str | Path | None, environment: str, given: Sequence[Wrapper] | None, preset: Sequence[dict[str, object]]
) -> tuple[dict[str, str] | None, Sequence[Wrapper] | None]:
    """What is recorded of the reward that a run begins with, and its wrappers: the reward's first, then those given, or the preset's."""
    if reward is None:
        return None, given
    stored = reward_of(reward, environment)
    others = [build_wrapper(part) for part in preset] if given is None else given
    return as_recorded(stored), [learned_reward(stored.members, stored.net_arch), *others]


def reward_of(where: str | Path, environment: str) -> StoredReward:
    """A reward to train on. Raises ``UserError`` if it does not belong to the environment."""
    stored = read_reward(where)
    check_fits(stored, environment)
    return stored
