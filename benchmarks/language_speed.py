"""Speed and memory of language models beside transformers and TRL, alternating, on one core with one thread, at two sizes.

    .venv/bin/python benchmarks/language_speed.py --repeats 3 --core 1
    .venv/bin/python benchmarks/language_speed.py --only dpo,ppo --sizes "1.07 M"

The peers' environment is ``.venv-trl`` (``make trl`` makes it), or what ``--peers`` says: TRL, and in a folder ``trl-1.12.0`` in it the
last TRL that had PPO. Writes ``results/language/speed.json`` after every pair of processes, with the raw values of each.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "peers"))

from language_task import BATCH, NEW, PROMPT, SIZES

from machine import commit, processor, versions
from processes import last_json, run_pinned

HERE = Path(__file__).parent
ROOT = HERE.parent
RESULTS = HERE / "results" / "language" / "speed.json"
TASKS = {"generate": 5, "dpo": 4, "grpo": 4, "ppo": 2}
"""Steps of a window; ``generate``: calls."""
PPO_BY = "trl-1.12.0"
GENERATION = ["--batch", str(BATCH), "--prompt", str(PROMPT), "--new", str(NEW), "--rounds"]
Line = dict[str, float]


def ours(task: str, folder: Path) -> list[str]:
    """The command of Thorndike's side."""
    if task == "generate":
        return [sys.executable, str(HERE / "thorndike_generate.py"), *GENERATION, str(TASKS[task]), str(folder / "policy")]
    return [sys.executable, str(HERE / "thorndike_learner.py"), task, "--steps", str(TASKS[task]), str(folder)]


def theirs(task: str, folder: Path, python: Path) -> list[str]:
    """The command of the peer's side."""
    if task == "generate":
        return [str(python), str(HERE / "peers" / "transformers_generate.py"), *GENERATION, str(TASKS[task]), str(folder / "policy")]
    return [str(python), str(HERE / "peers" / "trl_learner.py"), task, "--steps", str(TASKS[task]), str(folder)]


def measured(command: list[str], path: list[Path], core: int, cache: Path) -> Line:
    """What one process said of itself. Raises ``SystemExit`` with its last words if it failed."""
    variables = {"PYTHONPATH": os.pathsep.join(map(str, path)), "THORNDIKE_CACHE": str(cache), "HF_HUB_OFFLINE": "1"}
    done = run_pinned(command, variables, core, 1800)
    line = last_json(done.stdout)
    if done.exit_code or line is None:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr[-2000:]}")
    return {name: value for name, value in line.items() if isinstance(value, int | float)}


def parameters_of(size: str, folder: Path, core: int, cache: Path) -> int:
    """Make a size's folder, in a process of its own: a child's peak memory begins at its parent's size, which must stay small."""
    folder.mkdir()
    variables = {"PYTHONPATH": str(ROOT / "src"), "THORNDIKE_CACHE": str(cache)}
    made = run_pinned([sys.executable, str(HERE / "language_models.py"), size, str(folder)], variables, core, 600)
    if made.exit_code:
        raise SystemExit(made.stderr[-2000:])
    return int(made.stdout.split()[-1])


def summary(rounds: list[dict[str, Line]]) -> dict[str, object]:
    """Medians of both sides, their ratio in each round, and the raw values."""

    def median(side: str, name: str) -> float:
        return statistics.median(each[side][name] for each in rounds)

    def rate(line: Line) -> float:
        return line["steps"] / line["cpu_s"]

    ratios = [rate(each["Thorndike"]) / rate(each["peer"]) for each in rounds]
    return {
        "per_cpu_s": {side: statistics.median(rate(each[side]) for each in rounds) for side in ("Thorndike", "peer")},
        "peak_memory_mb": {side: median(side, "peak_memory_mb") for side in ("Thorndike", "peer")},
        "ratio_per_cpu_s": statistics.median(ratios),
        "ratios": ratios,
        "memory_ratio": median("Thorndike", "peak_memory_mb") / median("peer", "peak_memory_mb"),
        # The first round compiles, the others find it in the cache.
        "memory_ratio_when_compiling": rounds[0]["Thorndike"]["peak_memory_mb"] / median("peer", "peak_memory_mb"),
        "rounds": rounds,
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--core", type=int, default=1)
    parser.add_argument("--only", default=",".join(TASKS), help=f"of {', '.join(TASKS)}")
    parser.add_argument("--sizes", default=",".join(SIZES), help=f"of {', '.join(SIZES)}")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-trl", help="the environment with transformers and TRL")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    python, old = options.peers / "bin" / "python", options.peers / PPO_BY
    found: dict[str, dict[str, list[dict[str, Line]]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        cache = Path(scratch) / "cache"
        parameters = {size: parameters_of(size, Path(scratch) / size, options.core, cache) for size in options.sizes.split(",")}
        for number in range(options.repeats):
            for size in parameters:
                for task in options.only.split(","):
                    folder, path = Path(scratch) / size, [old] if task == "ppo" else []
                    each = {
                        "Thorndike": measured(ours(task, folder), [ROOT / "src"], options.core, cache),
                        "peer": measured(theirs(task, folder, python), [*path, HERE / "peers"], options.core, cache),
                    }
                    found.setdefault(size, {}).setdefault(task, []).append(each)
                    shown = summary(found[size][task])
                    print(number, size, task, {name: shown[name] for name in ("ratios", "per_cpu_s", "peak_memory_mb")}, flush=True)
                    content = {
                        "command": "python benchmarks/language_speed.py " + " ".join(sys.argv[1:]), "commit": commit(ROOT),
                        "processor": processor(), "load": list(os.getloadavg()), "steps": TASKS, "parameters": parameters,
                        "versions": {"thorndike": versions(Path(sys.executable)), "peers": versions(python)},
                        "sizes": {name: {each: summary(rounds) for each, rounds in tasks.items()} for name, tasks in found.items()},
                    }  # fmt: skip
                    options.results.parent.mkdir(parents=True, exist_ok=True)
                    options.results.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
