"""Which runs are compared with which, and what was recorded of their evaluations. JSON files only: mistakes must not wait for JAX."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from thorndike.errors import UserError
from thorndike.training.json_files import FLAG, NUMBER, OBJECT, TEXT, check_fields, optional, parse_object, whole
from thorndike.training.run_directory import read_run

RunPath: TypeAlias = str | Path
Entry: TypeAlias = RunPath | Sequence[RunPath]
"""One run, or several whose seeds count together."""

_STAMP = len("20260101-120000-")
_FIELDS = {
    "algorithm": TEXT,
    "environment": TEXT,
    "env_kwargs": OBJECT,
    "max_episode_steps": optional(whole(1)),
    "config": OBJECT,
    "seeds": whole(1),
    "seed": whole(0),
    "steps": whole(1),
    "status": TEXT,
}
_EVALUATED = {"seed": whole(0), "episode": whole(0), "return": NUMBER, "evaluation_seed": whole(0), "deterministic": FLAG}


class Trained(NamedTuple):
    """What of a run matters when it is compared with others."""

    run: Path
    algorithm: str
    environment: str
    """Its id, with the arguments and the time limit where they are not its own."""
    name: str
    seeds: int
    seed: int
    steps: int
    status: str
    settings: Mapping[str, object]
    """All that must be equal for two runs to be more seeds of the same learner."""


class Group(NamedTuple):
    """One side of a comparison."""

    label: str
    runs: Mapping[str, tuple[Trained, ...]]
    """Of each environment the runs whose seeds count together."""


class Groups(NamedTuple):
    """Everything that is compared."""

    groups: tuple[Group, ...]
    baseline: str
    """The label of the group that the others are compared with."""
    environments: tuple[str, ...]
    """Those that every group was trained on."""
    notes: tuple[str, ...]
    """What a reader of the comparison must know, a sentence each."""


def group_runs(runs: Sequence[Entry] | Mapping[str, Entry], against: RunPath | None = None) -> Groups:
    """Sort runs into the sides of a comparison.

    Each entry is a side; the runs of an entry with several count as more seeds of one learner. Single runs of the same learner on different
    environments (the same algorithm, or the same ``--name``) are one side too. A mapping names the sides itself. ``against`` is the
    baseline, a run or a key of the mapping; the last side if it is not given. Raises UserError for fewer than two sides, sides without a
    common environment, and runs that are no seeds of one learner.
    """
    entries = [_read_entry(entry) for entry in (runs.values() if isinstance(runs, Mapping) else runs)]
    named = list(runs) if isinstance(runs, Mapping) else []
    if against is not None and str(against) not in named and not _holding(entries, against):
        entries.append(_read_entry(against))
        named = [*named, Path(against).name] if named else []
    _refuse_doubles(entries)
    labels = named or _labels(entries)
    groups = tuple(Group(label, _by_environment(label, entries, labels)) for label in dict.fromkeys(labels))
    environments = _common_environments(groups)
    if against is None or str(against) in labels:
        baseline = groups[-1].label if against is None else str(against)
    else:
        baseline = labels[entries.index(_holding(entries, against)[0])]
    groups = tuple(Group(group.label, {place: group.runs[place] for place in environments}) for group in groups)
    return Groups(groups, baseline, environments, (*_left_out(entries, environments), *_differences(groups)))


def all_trained(found: Groups) -> list[Trained]:
    """Every run of a comparison."""
    return [trained for group in found.groups for together in group.runs.values() for trained in together]


def recorded_scores(trained: Trained, episodes: int) -> list[float] | None:
    """Each seed's mean return in the last evaluation of ``evaluations.jsonl``; None if it does not count.

    It counts if it was made with the greedy policy, of every seed, over at least ``episodes`` episodes each, and after the policy was
    written last.
    """
    path, policy = trained.run / "evaluations.jsonl", trained.run / "policy" / "manifest.json"
    if not path.is_file() or (policy.is_file() and path.stat().st_mtime_ns < policy.stat().st_mtime_ns):
        return None
    rows = _read_rows(path)
    returns: dict[int, list[float]] = {}
    before = None
    for row in reversed(rows):
        # Within one evaluation seeds, and the episodes of each, are in order.
        place = (row["seed"], row["episode"])
        if (before is not None and place >= before) or (row["evaluation_seed"], row["deterministic"]) != (
            rows[-1]["evaluation_seed"],
            True,
        ):
            break
        returns.setdefault(row["seed"], []).append(row["return"])
        before = place
    complete = len(returns) == trained.seeds and all(len(told) >= episodes for told in returns.values())
    return [sum(told) / len(told) for _, told in sorted(returns.items())] if complete else None


def _read_rows(path: Path) -> list[dict]:
    # A process that was killed may have left half a line: whatever no newline ends is not there.
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    try:
        rows = [parse_object(line.encode(), path) for line in lines]
        for row in rows:
            check_fields(row, _EVALUATED, path)
    except UserError as error:
        raise UserError(f"{error}; remove it: the policies are then evaluated anew") from None
    return rows


def _read_entry(entry: Entry) -> tuple[Trained, ...]:
    paths = [entry] if isinstance(entry, str | Path) else list(entry)
    if not paths:
        raise UserError("a side of a comparison has no run: give at least one")
    return tuple(_read_trained(Path(path)) for path in paths)


def _read_trained(run: Path) -> Trained:
    facts = read_run(run)
    check_fields(facts, _FIELDS, run / "run.json")
    if not any((run / name).exists() for name in ("policy", "policy.old", "evaluations.jsonl")):
        raise UserError(f"{run} has no trained policy to compare: it has not reached its first checkpoint; train longer")
    changed = {**facts["env_kwargs"], **({"steps at most": facts["max_episode_steps"]} if facts["max_episode_steps"] else {})}
    told = ", ".join(f"{name}={value}" for name, value in changed.items())
    environment = facts["environment"] + (f" ({told})" if told else "")
    settings = {**facts["config"], **{name: facts.get(name) for name in ("algorithm", "num_envs", "wrappers", "network", "steps")}}
    return Trained(
        run=run,
        algorithm=facts["algorithm"],
        environment=environment,
        name=run.resolve().name[_STAMP:] or run.name,
        seeds=facts["seeds"],
        seed=facts["seed"],
        steps=facts.get("steps_done", facts["steps"]),
        status=facts["status"],
        settings=settings,
    )


def _holding(entries: Sequence[tuple[Trained, ...]], run: RunPath) -> list[tuple[Trained, ...]]:
    return [entry for entry in entries if any(trained.run.resolve() == Path(run).resolve() for trained in entry)]


def _refuse_doubles(entries: Sequence[tuple[Trained, ...]]) -> None:
    paths = [trained.run.resolve() for entry in entries for trained in entry]
    double = next((path for path in paths if paths.count(path) > 1), None)
    if double is not None:
        raise UserError(f"{double} was given twice: a run cannot be compared with itself")


def _labels(entries: Sequence[tuple[Trained, ...]]) -> list[str]:
    """A name for each entry, as short as tells them apart; entries that get the same one are one side."""
    one_side_may_be_several = all(len(entry) == 1 for entry in entries)
    kinds: tuple[Callable[[Trained], str], ...] = (
        lambda trained: trained.algorithm,
        lambda trained: trained.name,
        lambda trained: f"{trained.algorithm} {trained.name}",
        lambda trained: trained.run.resolve().name,
    )
    for kind in kinds:
        labels = ["+".join(dict.fromkeys(map(kind, entry))) for entry in entries]
        places = [(label, entry[0].environment if one_side_may_be_several else "") for label, entry in zip(labels, entries, strict=True)]
        if len(set(places)) == len(places):
            return labels
    return ["+".join(str(trained.run) for trained in entry) for entry in entries]


def _by_environment(label: str, entries: Sequence[tuple[Trained, ...]], labels: Sequence[str]) -> dict[str, tuple[Trained, ...]]:
    members = [trained for name, entry in zip(labels, entries, strict=True) if name == label for trained in entry]
    found: dict[str, tuple[Trained, ...]] = {}
    for trained in members:
        together = found.get(trained.environment, ())
        for other in together:
            _refuse_mixture(other, trained)
        found[trained.environment] = (*together, trained)
    return found


def _refuse_mixture(first: Trained, second: Trained) -> None:
    """Seeds count together only if they are different seeds of the same learner."""
    # A setting that one of them was trained without came with a later version.
    different = [name for name in first.settings if first.settings[name] != second.settings.get(name, first.settings[name])]
    if different:
        name = different[0]
        values = f"{first.settings[name]} and {second.settings[name]}"
        raise UserError(f"{first.run} and {second.run} are not seeds of the same learner: {name} is {values}; give them as two sides")
    if first.seed == second.seed:
        raise UserError(f"{first.run} and {second.run} hold the same agents, those of seed {first.seed}; train more with another --seed")


def _common_environments(groups: Sequence[Group]) -> tuple[str, ...]:
    if len(groups) < 2:
        what = " and ".join(f"{group.label} on {', '.join(group.runs)}" for group in groups)
        raise UserError(f"expected at least two learners to compare, got {what or 'none'}: name a run of another, or --against RUN")
    common = tuple(place for place in groups[0].runs if all(place in group.runs for group in groups))
    if not common:
        where = "; ".join(f"{group.label} on {', '.join(group.runs)}" for group in groups)
        raise UserError(f"the environments differ, there is none in common: {where}; compare runs on the same environment")
    return common


def _left_out(entries: Sequence[tuple[Trained, ...]], environments: Sequence[str]) -> list[str]:
    left = dict.fromkeys(trained.environment for entry in entries for trained in entry if trained.environment not in environments)
    return [f"the environments differ: {', '.join(left)} left out, as not every learner was trained there"] if left else []


def _differences(groups: Sequence[Group]) -> list[str]:
    """What makes a comparison less fair than it looks."""
    notes = []
    members = [(group.label, trained) for group in groups for together in group.runs.values() for trained in together]
    for place in groups[0].runs:
        steps = {label: trained.steps for label, trained in members if trained.environment == place}
        # Runs end with a whole iteration: a few steps more are no advantage.
        if max(steps.values()) > 1.05 * min(steps.values()):
            notes.append(f"trained for different numbers of steps on {place}: {', '.join(f'{k} {v:,}' for k, v in steps.items())}")
    notes += [f"{trained.run} is not finished: its status is {trained.status}" for _, trained in members if trained.status != "finished"]
    for number, (label, trained) in enumerate(members):
        same = [
            name
            for name, other in members[:number]
            if name != label and (other.environment, other.seed, other.settings) == (trained.environment, trained.seed, trained.settings)
        ]
        notes += [f"{name} and {label} have the same settings and the same seed: they are the same agents, trained twice" for name in same]
    return notes
