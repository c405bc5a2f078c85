"""``td.check_env``: what is wrong with an environment, before anything is trained in it."""

from collections.abc import Mapping

from thorndike.environments import registry
from thorndike.environments.checker import Report, check
from thorndike.environments.checking.findings import Finding
from thorndike.errors import UserError


def check_env(
    environment: "registry.Named",
    *,
    steps: int = 1000,
    seed: int = 0,
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
) -> list[Finding]:
    """Play an environment with random actions and list what is wrong with it, each with its fix: errors, then warnings, then hints.

    `environment`: an id, ``module:Class``, ``path/to/file.py:Class``, class, function or object (which is copied, never stepped itself).
    `steps` are recorded and repeated; below 100 rewards and ranges are not judged. Raises UserError if the environment cannot be made.
    """
    return examine(environment, steps=steps, seed=seed, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps).findings


def examine(
    environment: "registry.Named",
    *,
    steps: int = 1000,
    seed: int = 0,
    env_kwargs: Mapping[str, object] | None = None,
    max_episode_steps: int | None = None,
) -> Report:
    """``check_env``, and what was played and looked at."""
    if steps < 1 or seed < 0:
        raise UserError(f"check_env needs at least 1 step and a seed of at least 0, not steps={steps} and seed={seed}")
    try:
        # Asked so, no environment is made yet: whatever is wrong with it is for the check to say.
        choice = registry.resolve(environment, engine="gymnasium", env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    except UserError:
        # It may exist as a compiled engine or in a pool alone; if not, this says so.
        choice = registry.resolve(environment, env_kwargs=env_kwargs, max_episode_steps=max_episode_steps)
    return check(lambda: registry.reference(choice), steps, seed)
