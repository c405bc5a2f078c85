"""Datasets of recorded episodes in Minari's format (0.5): HDF5 and a JSON file beside it, read and written with h5py alone.

A dataset is a folder, ``NAME/data/main_data.hdf5`` and ``NAME/data/metadata.json``; below a common root, a path such as
``CartPole-v1/ppo-v0`` is its Minari id. Each episode keeps T + 1 observations, T actions, rewards, terminations and truncations; what
Thorndike records has the probability of every Discrete action beside them (``infos/behavior_probability``).
"""

import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, cast

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from jaxtyping import PyTree

from thorndike.environments.host.arrays import array_dtype
from thorndike.errors import UserError
from thorndike.learning_sources import DATA, METADATA, is_dataset
from thorndike.training.json_files import OBJECT, TEXT, Json, as_bytes, check_fields, optional, parse_object, read_object, whole
from thorndike.training.minari_spaces import is_encoded_image, space_of_text, space_text

if TYPE_CHECKING:
    import h5py

PROBABILITY = "behavior_probability"
_PARTS = ("observations", "actions", "rewards", "terminations", "truncations")
_MINARI = "0.5.4"
"""The version of the format that is written."""


class Episode(NamedTuple):
    """One episode of ``T`` steps."""

    obs: PyTree
    """``[T + 1, ...]``: what was acted on, and what the last action led to."""
    action: np.ndarray
    """``[T, ...]`` in the environment's units."""
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    probability: np.ndarray | None
    """Of each action under the policy that acted; None where nobody wrote it down."""
    seed: int | None = None


class Origin(NamedTuple):
    """The environment that a dataset was recorded in."""

    environment: str
    env_kwargs: dict[str, object]
    max_episode_steps: int | None
    observation_space: spaces.Space
    action_space: spaces.Space


class Dataset(NamedTuple):
    """A dataset in memory, its N steps one after another."""

    path: Path
    origin: Origin
    obs: PyTree
    """``[N, ...]``, float32, int32 or uint8, as a learner sees them."""
    next_obs: PyTree
    """The true successors ``[N, ...]``."""
    action: np.ndarray
    """``[N, ...]`` in the environment's units, whole numbers from 0."""
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    """The last step of an episode that was simply cut off counts as truncated."""
    probability: np.ndarray | None
    lengths: np.ndarray
    """Steps of each episode, int64 ``[E]``."""
    sha256: str
    """Of the file that holds the steps."""

    @property
    def starts(self) -> np.ndarray:
        """The first step of each episode."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def returns(self) -> np.ndarray:
        """The sum of each episode's rewards."""
        return np.add.reduceat(self.reward.astype(np.float64), self.starts)


def read_dataset(path: str | Path) -> Dataset:
    """The dataset in a folder. Raises ``UserError``, in one line that names file and episode, for one that is malformed."""
    path = Path(path)
    if not is_dataset(path):
        raise UserError(
            f"{path} is no dataset: it has no {METADATA}; make one with thorndike record RUN, or give a Minari dataset's folder"
        )
    facts = read_object(path / METADATA)
    origin, file = _origin(facts, path / METADATA), path / DATA
    if facts.get("data_format", "hdf5") != "hdf5":
        raise UserError(f"{path / METADATA}: the data are {facts['data_format']}; thorndike reads hdf5: convert the dataset with Minari")
    images = [leaf for leaf in _leaves(origin.observation_space) if is_encoded_image(leaf)]
    if facts.get("jpeg_encoding", True) and images:
        raise UserError(f"{path / METADATA}: its pictures are JPEG; make the dataset again with jpeg_encoding=False")
    library = _h5py()
    try:
        with library.File(file, "r") as opened:
            episodes = [_read_episode(opened[name], origin, f"{file}, {name}") for name in _episode_names(opened, file)]
    except OSError as error:
        raise UserError(f"{file} cannot be read as HDF5: {str(error)[:120]}") from error
    return _joined(path, origin, episodes, _digest(file))


def write_dataset(path: str | Path, origin: Origin, episodes: Sequence[Episode], about: Json) -> Path:
    """A new dataset folder that Minari reads too. ``about`` is further metadata.

    Raises ``UserError`` if there is something already, or it cannot be written.
    """
    path, library = Path(path), _h5py()
    if not episodes:
        raise UserError(f"{path}: a dataset has at least one episode")
    try:
        (path / "data").mkdir(parents=True)
        with library.File(path / DATA, "w") as file:
            for number, episode in enumerate(episodes):
                _write_episode(file.create_group(f"episode_{number}"), number, episode, origin)
        facts = _metadata(path, origin, episodes) | about
        (path / METADATA).write_bytes(as_bytes(facts))
    except FileExistsError as error:
        raise UserError(f"{path} is there already: a dataset is never written over; choose another folder with --to") from error
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    return path


def mixed(path: str | Path, parts: Sequence[Dataset], about: Json | None = None) -> Path:
    """A new dataset of all episodes of others, which come from one environment. Raises ``UserError`` if they do not."""
    first = parts[0].origin
    for part in parts:
        if part.origin[:3] != first[:3]:
            raise UserError(f"{part.path} is of {part.origin.environment}, {parts[0].path} of {first.environment}: mix datasets of one")
    return write_dataset(path, first, [episode for part in parts for episode in episodes_of(part)], about or {})


def episodes_of(data: Dataset) -> Iterable[Episode]:
    """The episodes of a dataset, one by one."""
    for start, length in zip(data.starts, data.lengths, strict=True):
        rows = slice(start, start + length)
        last = slice(start + length - 1, start + length)
        yield Episode(
            jax.tree.map(lambda now, then, rows=rows, last=last: np.concatenate([now[rows], then[last]]), data.obs, data.next_obs),
            data.action[rows] + _start(data.origin.action_space),
            data.reward[rows],
            data.terminated[rows],
            data.truncated[rows],
            None if data.probability is None else data.probability[rows],
        )


def _origin(facts: Json, where: Path) -> Origin:
    """What environment a dataset is of: as Thorndike wrote it down, or from Gymnasium's own description."""
    found = facts.get("thorndike")
    if found is None:
        text = facts.get("env_spec")
        if not isinstance(text, str):
            raise UserError(f"{where} does not name the environment it was recorded in (env_spec): make the dataset again with it")
        spec = parse_object(text.encode(), where)
        kwargs, limit = spec.get("kwargs") or {}, spec.get("max_episode_steps")
        found = {"environment": spec.get("id"), "env_kwargs": kwargs, "max_episode_steps": limit}
    check_fields({"thorndike": found}, {"thorndike": OBJECT}, where)
    named = cast(Json, found)
    check_fields(named, {"environment": TEXT, "env_kwargs": OBJECT, "max_episode_steps": optional(whole(1))}, where)
    observations, actions = (space_of_text(facts.get(part), where) for part in ("observation_space", "action_space"))
    if isinstance(actions, spaces.Dict | spaces.Tuple):
        raise UserError(f"{where}: actions of {type(actions).__name__} spaces are not supported; flatten them")
    limit = cast(int | None, named["max_episode_steps"])
    return Origin(cast(str, named["environment"]), cast(Json, named["env_kwargs"]), limit, observations, actions)


def _episode_names(file: "h5py.File", where: Path) -> list[str]:
    names = [name for name in file if name.startswith("episode_") and name[8:].isdigit()]
    if not names:
        raise UserError(f"{where} holds no episode")
    return sorted(names, key=lambda name: int(name[8:]))


def _read_episode(group: "h5py.Group", origin: Origin, where: str) -> Episode:
    for name in _PARTS:
        if name not in group:
            raise UserError(f"{where}: it has no {name}")
    obs = _observations(group["observations"], origin.observation_space, f"{where}, observations")
    reward = _numbers(group["rewards"], np.float32, f"{where}, rewards")
    steps = len(reward)
    if steps == 0:
        raise UserError(f"{where}: it has no step")
    action = _actions(group["actions"], origin.action_space, f"{where}, actions")
    terminated, truncated = (np.asarray(group[name][()]).astype(bool) for name in ("terminations", "truncations"))
    infos = group.get("infos")
    probability = None if infos is None or PROBABILITY not in infos else _numbers(infos[PROBABILITY], np.float64, f"{where}, {PROBABILITY}")
    lengths = {"actions": len(action), "terminations": len(terminated), "truncations": len(truncated)}
    lengths |= {} if probability is None else {PROBABILITY: len(probability)}
    for name, length in lengths.items():
        if length != steps:
            raise UserError(f"{where}: {length} {name} for {steps} rewards")
    seen = {len(leaf) for leaf in jax.tree.leaves(obs)}
    if seen != {steps + 1}:
        raise UserError(f"{where}: {min(seen)} observations for {steps} rewards; there is one more of them than of rewards")
    early = np.flatnonzero((terminated | truncated)[:-1])
    if len(early):
        raise UserError(f"{where}: it ends at step {early[0]}, but has {steps} steps")
    if probability is not None and not ((probability > 0) & (probability <= 1)).all():
        raise UserError(f"{where}: a {PROBABILITY} is not above 0 and at most 1")
    return Episode(obs, action, reward, terminated, truncated, probability)


def _observations(stored: "h5py.Group", space: spaces.Space, where: str) -> PyTree:
    match space:
        case spaces.Dict():
            return {name: _observations(_member(stored, name, where), part, f"{where}/{name}") for name, part in space.spaces.items()}
        case spaces.Tuple():
            parts = enumerate(space.spaces)
            return tuple(_observations(_member(stored, f"_index_{i}", where), part, f"{where}/{i}") for i, part in parts)
    if not hasattr(stored, "dtype"):
        raise UserError(f"{where}: a group, where {space} needs an array")
    found = _numbers(stored, array_dtype(space.dtype), where)
    if found.shape[1:] != (space.shape or ()):
        raise UserError(f"{where}: rows of shape {found.shape[1:]}, but the space is {space}")
    return found


def _member(stored: "h5py.Group", name: str, where: str) -> "h5py.Group":
    if hasattr(stored, "dtype") or name not in stored:
        raise UserError(f"{where}: it has no {name}")
    return stored[name]


def _actions(stored: "h5py.Dataset", space: spaces.Space, where: str) -> np.ndarray:
    """Actions, whole numbers counted from 0."""
    found = _numbers(stored, array_dtype(space.dtype), where)
    if found.shape[1:] != (space.shape or ()):
        raise UserError(f"{where}: rows of shape {found.shape[1:]}, but the space is {space}")
    if isinstance(space, spaces.Box):
        slack = 1e-4 * np.maximum(1.0, np.abs(space.high))
        inside = (found >= space.low - slack) & (found <= space.high + slack)
    else:
        found = found - _start(space)
        most = getattr(space, "nvec", getattr(space, "n", 2)) if not isinstance(space, spaces.MultiBinary) else 2
        inside = (found >= 0) & (found < most)
    if not inside.all():
        step = int(np.argwhere(~inside)[0][0])
        raise UserError(f"{where}: the action of step {step} is outside of {space}")
    return found


def _numbers(stored: "h5py.Dataset", kind: type | np.dtype, where: str) -> np.ndarray:
    found = np.asarray(stored[()])
    if found.dtype.kind not in "biuf":
        raise UserError(f"{where}: expected numbers, got {found.dtype}")
    if found.ndim == 0:
        raise UserError(f"{where}: expected a row a step, got a single number")
    if not np.isfinite(found).all():
        raise UserError(f"{where}: the number of step {int(np.argwhere(~np.isfinite(found))[0][0])} is not finite")
    return found.astype(kind)


def _joined(path: Path, origin: Origin, episodes: Sequence[Episode], sha256: str) -> Dataset:
    def joined(rows: slice) -> PyTree:
        return jax.tree.map(lambda *leaves: np.concatenate([leaf[rows] for leaf in leaves]), *[episode.obs for episode in episodes])

    for episode in episodes:
        # Written by a collector that was stopped: the future is unknown, not worth 0.
        episode.truncated[-1] |= not episode.terminated[-1]
    known = [episode.probability for episode in episodes if episode.probability is not None]
    return Dataset(
        path=path,
        origin=origin,
        obs=joined(slice(None, -1)),
        next_obs=joined(slice(1, None)),
        action=np.concatenate([episode.action for episode in episodes]),
        reward=np.concatenate([episode.reward for episode in episodes]),
        terminated=np.concatenate([episode.terminated for episode in episodes]),
        truncated=np.concatenate([episode.truncated for episode in episodes]),
        probability=np.concatenate(known) if len(known) == len(episodes) else None,
        lengths=np.array([len(episode.reward) for episode in episodes], np.int64),
        sha256=sha256,
    )


def _write_episode(group: "h5py.Group", number: int, episode: Episode, origin: Origin) -> None:
    group.attrs["id"] = number
    group.attrs["total_steps"] = len(episode.reward)
    if episode.seed is not None:
        group.attrs["seed"] = episode.seed
    for name, value in zip(("sum", "mean", "std", "max", "min"), _statistics(episode.reward), strict=True):
        group.attrs[f"rewards_{name}"] = value
    _write_tree(group, "observations", episode.obs, origin.observation_space)
    group.create_dataset("actions", data=episode.action.astype(origin.action_space.dtype))
    group.create_dataset("rewards", data=episode.reward.astype(np.float64))
    group.create_dataset("terminations", data=episode.terminated)
    group.create_dataset("truncations", data=episode.truncated)
    infos = group.create_group("infos")
    if episode.probability is not None:
        infos.create_dataset(PROBABILITY, data=episode.probability)


def _statistics(reward: np.ndarray) -> tuple[float, ...]:
    wide = reward.astype(np.float64)
    return float(wide.sum()), float(wide.mean()), float(wide.std()), float(wide.max()), float(wide.min())


def _write_tree(group: "h5py.Group", name: str, tree: PyTree, space: spaces.Space) -> None:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        below = group.create_group(name)
        named = space.spaces.items() if isinstance(space, spaces.Dict) else ((f"_index_{i}", part) for i, part in enumerate(space.spaces))
        values = tree.values() if isinstance(tree, dict) else tree
        parts = dict(zip(tree, values, strict=True)) if isinstance(tree, dict) else {f"_index_{i}": part for i, part in enumerate(values)}
        for key, part in named:
            _write_tree(below, key, parts[key], part)
        return
    group.create_dataset(name, data=np.asarray(tree).astype(space.dtype))


def _metadata(path: Path, origin: Origin, episodes: Sequence[Episode]) -> Json:
    facts: Json = {
        "total_episodes": len(episodes),
        "total_steps": sum(len(episode.reward) for episode in episodes),
        "data_format": "hdf5",
        "jpeg_encoding": False,
        "observation_space": space_text(origin.observation_space),
        "action_space": space_text(origin.action_space),
        "dataset_size": round(os.path.getsize(path / DATA) / 1e6, 1),
        "dataset_id": f"{path.absolute().parent.name}/{path.name}",
        "minari_version": _MINARI,
        "thorndike": dict(zip(("environment", "env_kwargs", "max_episode_steps"), origin[:3], strict=True)),
    }
    known = gymnasium.registry.get(origin.environment)
    if known is not None:
        spec = json.loads(known.to_json())
        spec["kwargs"] |= origin.env_kwargs
        spec["max_episode_steps"] = origin.max_episode_steps or spec["max_episode_steps"]
        facts["env_spec"] = json.dumps(spec)
    return facts


def _start(space: spaces.Space) -> np.ndarray | int:
    return np.asarray(space.start, np.int32) if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) else 0


def _leaves(space: spaces.Space) -> list[spaces.Space]:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return [leaf for part in parts for leaf in _leaves(part)]
    return [space]


def _digest(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def _h5py() -> ModuleType:
    try:
        import h5py
    except ImportError as error:
        raise UserError("datasets need h5py, which is not installed: pip install 'thorndike[offline]'") from error
    return h5py
