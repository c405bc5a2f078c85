"""The exported policy of a run: actors and normaliser statistics of every seed, and all it takes to rebuild them. No code."""

import math
from collections.abc import Sequence
from pathlib import Path

import jax

from thorndike.api.building import Job
from thorndike.environments.wrappers import exported
from thorndike.records import POLICY_FORMAT
from thorndike.training.host_source import HostSource
from thorndike.training.json_files import as_bytes
from thorndike.training.metrics import LogPoint
from thorndike.training.sealed_folders import NewFolder
from thorndike.training.segment import Carry
from thorndike.training.space_files import space_to_json
from thorndike.training.tree_files import write_tree


def export_policy(run: Path, record: dict[str, object], job: Job, carry: Carry, points: Sequence[LogPoint]) -> None:
    """Write ``policy/`` aside and rename it into place. The best seed is the one with the highest return over ``points``."""
    source = job.source.source if isinstance(job.source, HostSource) else job.source
    shown = exported(job.wrapper, source.statistics(carry.source))
    actors = jax.vmap(job.algorithm.actor)(carry.learner)
    write_policy(
        run,
        {"actor": actors, "statistics": shown.statistics},
        {
            "algorithm": job.request.algorithm,
            "config": job.request.config,
            "network": record["network"],
            "environment": job.request.environment,
            "environment_object": record["environment_object"],
            "env_kwargs": job.request.env_kwargs,
            "max_episode_steps": job.request.max_episode_steps,
            "num_envs": job.request.num_envs,
            "wrappers": shown.settings,
            "observation_space": space_to_json(job.spec.observation_space),
            "action_space": space_to_json(job.spec.action_space),
            "seeds": job.request.seeds,
            "best": _best(points, job.request.seeds),
        },
    )


def write_policy(run: Path, arrays: dict, content: dict[str, object]) -> None:
    """Write arrays and description as the run's policy, replacing the one before."""
    new = NewFolder(run / "policy.partial")
    write_tree(arrays, new, "policy")
    new.write("policy.json", as_bytes({"format": POLICY_FORMAT, **content}))
    new.publish(run / "policy")


def _best(points: Sequence[LogPoint], seeds: int) -> int:
    """The seed with the highest mean training return over the points; one that ended no episode there is never the best."""
    returns = [[point.values["rollout/ep_rew_mean"][seed] for point in points] for seed in range(seeds)]
    means = [[value for value in values if value is not None] for values in returns]
    return max(range(seeds), key=lambda seed: sum(means[seed]) / len(means[seed]) if means[seed] else -math.inf)
