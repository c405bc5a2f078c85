"""``make bench``: Thorndike against its peers, alternating A B C A B C ... in one run, every process on the same one core.

Writes ``benchmarks/results/<task>.json`` after each task and the tables of ``docs/performance.md`` from them. The protocol is in README.md.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

from contestants import TASKS, Claim, Contestant, Task
from machine import facts
from processes import Finished, cores, fill, last_json, make_folder, replace, run_pinned
from tables import write_tables

HERE = Path(__file__).parent
ROOT = HERE.parent
Record = dict
RATES = ("steps_per_s", "steps_per_cpu_s")
MEDIANS = (*RATES, "steps", "wall_s", "cpu_s", "compile_s", "import_cpu_s", "total_cpu_s", "peak_memory_mb")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line of ``run.py``."""
    names = ",".join(task.name for task in TASKS)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=names, help=f"tasks, with commas between them (default: {names})")
    parser.add_argument("--contestants", default="", help="only contestants whose name starts with one of these, with commas between them")
    parser.add_argument("--repeats", type=int, default=3, help="rounds; every contestant runs once a round (default: 3)")
    parser.add_argument("--core", type=int, default=cores()[0], help="the core every contestant is pinned to")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers", help="virtual environment of the peers")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds before a contestant is given up (default: 300)")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="where the JSON goes")
    parser.add_argument("--tables-only", action="store_true", help="write docs/performance.md from the JSON that is there")
    options = parser.parse_args(arguments)
    options.results = options.results.absolute()
    unknown = set(options.only.split(",")) - {task.name for task in TASKS}
    if unknown:
        parser.error(f"--only: expected some of {names}; got {','.join(sorted(unknown))}")
    if options.repeats < 1:
        parser.error(f"--repeats: expected 1 or more; got {options.repeats}")
    return options


def stay_off(core: int) -> None:
    """Keep this driver off the contestants' core where the machine has another."""
    others = set(cores()) - {core}
    if others:
        os.sched_setaffinity(0, others)


def measured(task: Task, finished: Finished) -> Record:
    """What one run gave, in the words of the results file. ``error`` is there if it failed."""
    line = last_json(finished.stdout)
    if finished.exit_code != 0 or (line is None and task.kind != "startup"):
        tail = [text for text in finished.stderr.strip().splitlines() if text][-1:] or ["nothing on stderr"]
        return {"error": f"exit {finished.exit_code}: {tail[0][:300]}"}
    process = {"process_wall_s": finished.wall_s, "process_cpu_s": finished.cpu_s}
    if task.kind == "startup" or line is None:
        return {**process, "wall_s": finished.wall_s, "cpu_s": finished.cpu_s, "peak_memory_mb": finished.peak_memory_mb}
    record: Record = {**process, "peak_memory_mb": finished.peak_memory_mb, **line}
    reached_at = line.get("reached_at")
    if isinstance(reached_at, float):
        record["wall_s"] = reached_at - finished.spawned_at
    if task.kind == "rate":
        record |= {"steps_per_s": line["steps"] / line["wall_s"], "steps_per_cpu_s": line["steps"] / line["cpu_s"]}
    return record


def run_once(task: Task, contestant: Contestant, names: dict[str, str], options: argparse.Namespace) -> Record:
    """One process of one contestant; ``names`` fills its command."""
    environment = {key: replace(value, names) for key, value in contestant.environment.items()}
    core = None if contestant.pins_itself else options.core
    finished = run_pinned(fill(contestant.command, names), environment, core, options.timeout)
    return measured(task, finished)


def run_task(task: Task, contestants: list[Contestant], options: argparse.Namespace, folder: Path) -> dict[str, list[Record]]:
    """All rounds of one task: contestant -> its records, one a round."""
    names = {"python": ".venv/bin/python", "peers": str(options.peers.absolute() / "bin" / "python"), "core": str(options.core)}
    names |= {"shared_cache": make_folder(folder / "shared"), "warm_cache": make_folder(folder / "warm")}
    records: dict[str, list[Record]] = {contestant.name: [] for contestant in contestants}
    for contestant in contestants:
        if contestant.prepare:
            run_once(task, contestant, {**names, "seed": "1000", "fresh_cache": make_folder(folder / "prepare")}, options)
    for repetition in range(options.repeats):
        for number, contestant in enumerate(contestants):
            fresh = make_folder(folder / f"fresh-{repetition}-{number}")
            load = os.getloadavg()[0]
            record = run_once(task, contestant, {**names, "seed": str(repetition), "fresh_cache": fresh}, options)
            records[contestant.name].append({"repetition": repetition, "load_before": load, **record})
            print(f"{task.name:<11} round {repetition + 1}/{options.repeats}  {contestant.name:<32} {brief(record)}", flush=True)
    return records


def brief(record: Record) -> str:
    """One record for the terminal."""
    if "error" in record:
        return f"FAILED {record['error']}"
    if "steps_per_cpu_s" in record:
        return f"{record['steps_per_s']:>12,.0f} steps/s {record['steps_per_cpu_s']:>12,.0f} steps/CPU-s"
    if record.get("reached") is False:
        return f"not reached in {record['steps']:,} steps"
    return f"{record['cpu_s']:.2f} CPU-s {record['wall_s']:.2f} s"


def summary(records: list[Record]) -> Record:
    """Medians over the rounds that gave a figure; a threshold that was not reached counts as later than every other."""
    good = [record for record in records if "error" not in record]
    result: Record = {"runs": len(records), "failed": len(records) - len(good)}
    if any("reached" in record for record in good):
        result["reached"] = sum(record["reached"] is True for record in good)
    for name in MEDIANS:
        late = float("inf") if name in ("cpu_s", "wall_s") else None
        values = [late if record[name] is None or record.get("reached") is False else record[name] for record in good if name in record]
        numbers = [value for value in values if isinstance(value, int | float)]
        middle = statistics.median(numbers) if numbers else None
        result[name] = None if middle == float("inf") else middle
        if name in RATES and numbers:
            result[f"{name}_range"] = [min(numbers), max(numbers)]
    return result


def judge(claim: Claim, summaries: dict[str, Record], records: dict[str, list[Record]]) -> Record | None:
    """A claim with its figure and whether it holds; ``None`` if its contestants did not run."""
    if claim.of not in summaries or (claim.versus is not None and claim.versus not in summaries):
        return None
    ours = summaries[claim.of].get(claim.measure)
    said: Record = {"of": claim.of, "versus": claim.versus, "measure": claim.measure}
    if claim.versus is None:
        return {**said, "value": ours, "at_most": claim.at_most, "met": ours is not None and ours <= claim.at_most}
    theirs = summaries[claim.versus].get(claim.measure)
    ratio = ours / theirs if ours and theirs else None
    pairs = zip(records[claim.of], records[claim.versus], strict=True)
    rounds = [a[claim.measure] / b[claim.measure] for a, b in pairs if claim.measure in a and claim.measure in b]
    return {**said, "value": ratio, "each_round": rounds, "at_least": claim.at_least, "met": ratio is not None and ratio >= claim.at_least}


def result_of(task: Task, contestants: list[Contestant], records: dict[str, list[Record]], options: argparse.Namespace) -> Record:
    """The content of ``results/<task>.json``."""
    summaries = {name: summary(runs) for name, runs in records.items()}
    judged = [judge(claim, summaries, records) for claim in task.claims]
    return {
        "task": task.name,
        "title": task.title,
        "kind": task.kind,
        "settings": task.settings,
        "date": time.strftime("%Y-%m-%d %H:%M:%S"),
        "repeats": options.repeats,
        "core": options.core,
        **facts(ROOT, options.peers),
        "claims": [claim for claim in judged if claim is not None],
        "contestants": {
            contestant.name: {"command": list(contestant.command), "note": contestant.note, "median": summaries[contestant.name]}
            | {"raw": records[contestant.name]}
            for contestant in contestants
        },
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the chosen tasks from the repository's root; exit status 1 if a contestant failed (a claim that is not met is only printed)."""
    options = parse(arguments)
    if options.tables_only:
        write_tables(options.results, ROOT / "docs" / "performance.md")
        return 0
    os.chdir(ROOT)
    stay_off(options.core)
    options.results.mkdir(parents=True, exist_ok=True)
    wanted = options.only.split(",")
    prefixes = tuple(options.contestants.split(","))
    failures = 0
    for task in (task for task in TASKS if task.name in wanted):
        chosen = [contestant for contestant in task.contestants if contestant.name.startswith(prefixes)]
        with tempfile.TemporaryDirectory(prefix="thorndike-bench-") as folder:
            records = run_task(task, chosen, options, Path(folder))
        result = result_of(task, chosen, records, options)
        failures += sum("error" in record for runs in records.values() for record in runs)
        (options.results / f"{task.name}.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
        for claim in result["claims"]:
            print(f"{task.name:<11} {claim}", flush=True)
    if not options.contestants:
        write_tables(options.results, ROOT / "docs" / "performance.md")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
