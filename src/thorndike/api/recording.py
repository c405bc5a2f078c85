"""``record`` and ``dataset``: what a trained policy does, as a dataset that Minari reads too; and any such dataset in memory."""

import re
from pathlib import Path

from thorndike.algorithms import ALGORITHMS
from thorndike.api.loading import LoadedPolicy, load, reference_engines
from thorndike.errors import UserError
from thorndike.training.datasets import Dataset, Origin, mixed, read_dataset, write_dataset
from thorndike.training.recording import Behavior, Wanted, record_episodes

EPISODES = 100


def record(
    run: str | Path | LoadedPolicy,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    deterministic: bool = False,
    random_share: float = 0.0,
    seed: int = 0,
    to: str | Path | None = None,
) -> Dataset:
    """Record a trained policy on fresh reference environments: ``episodes`` of them (100), or whole ones until there are ``steps``.

    Actions are drawn as in training, or with ``deterministic`` are the policy's best; a ``random_share`` of them is uniform instead. The
    probability of every Discrete action is written down. The folder is ``datasets/<environment>/<algorithm>-v<N>`` if ``to`` does not say
    otherwise. Raises ``UserError`` for what cannot be recorded.
    """
    if episodes is not None and steps is not None:
        raise UserError(f"record so many episodes or so many steps, not both; got episodes={episodes} and steps={steps}")
    if not 0.0 <= random_share <= 1.0:
        raise UserError(f"random_share is a probability, between 0 and 1; got {random_share}")
    if (episodes is not None and episodes < 1) or (steps is not None and steps < 1):
        raise UserError(f"record at least one; got episodes={episodes}, steps={steps}")
    loaded = run if isinstance(run, LoadedPolicy) else load(run)
    policy, choice = loaded.policy, loaded.choice()
    space = policy.spec.observation_space
    where = free_place(choice.id, str(loaded.facts["algorithm"])) if to is None else Path(to)
    if where.exists():
        raise UserError(f"{where} is there already: a dataset is never written over; choose another folder with --to")
    wanted = Wanted(EPISODES if episodes is None and steps is None else episodes, steps)
    behavior = Behavior(deterministic, random_share)
    found = record_episodes(policy, reference_engines(choice, space), wanted, behavior, seed)
    origin = Origin(choice.id, dict(choice.env_kwargs), loaded.facts["max_episode_steps"], space, policy.spec.action_space)
    about: dict[str, object] = {
        "algorithm_name": f"thorndike {loaded.facts['algorithm']}",
        "behavior": {**behavior._asdict(), "seed": seed},
    }
    return read_dataset(write_dataset(where, origin, found, about))


def dataset(path: str | Path) -> Dataset:
    """The dataset in a folder: Thorndike's own, or one that Minari wrote. Raises ``UserError`` for one that is malformed."""
    return read_dataset(path)


def mix(*parts: str | Path, to: str | Path) -> Dataset:
    """A new dataset of all episodes of others, of one environment. Raises ``UserError``."""
    if len(parts) < 2:
        raise UserError("a mixture is of at least two datasets")
    return read_dataset(mixed(to, [read_dataset(part) for part in parts]))


def free_place(environment: str, algorithm: str) -> Path:
    """The first folder of this name that is not there yet: ``datasets/CartPole-v1/ppo-v0``."""
    folder = Path("datasets", re.sub(r"[^\w.-]+", "_", environment))
    name = algorithm if algorithm in ALGORITHMS else "policy"
    return next(place for number in range(10**6) if not (place := folder / f"{name}-v{number}").exists())
