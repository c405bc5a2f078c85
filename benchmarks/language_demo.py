"""The demo over seeds: `python benchmarks/language_demo.py --base MODEL [--seeds 11 12 13 14 15] [--learners ppo,rloo,dpo]`.

Runs `thorndike language demo` once a seed into --runs, or goes on with what is there, and writes after each seed
benchmarks/results/language/demo.json: the commands, every figure of the runs, without the texts, and what they give together: means over
seeds with Student's 95 % intervals. `--collect` runs nothing and takes the runs as they are; `--tables` only prints the tables of
docs/rlhf.md.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

RESULTS = Path(__file__).parent / "results" / "language" / "demo.json"
LEARNERS = ("ppo", "grpo", "rloo", "dpo", "ppo_without_kl", "ppo_max_kl")
STUDENT = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306, 10: 2.262}
"""Seeds -> the 97.5 % quantile of Student's distribution with one degree of freedom less."""
SMOOTH = 3
"""Iterations whose mean a point of a curve is, where a peak is looked for: a single batch's would be one of noise."""
Found = Mapping[str, object]
FIGURES: dict[str, Callable[[dict], float]] = {
    "win_rate": lambda part: part["judged"]["gold"]["win_rate"],
    "kl": lambda part: part["kl"],
    "gold": lambda part: part["judged"]["gold"]["policy"],
    "gold_of_base": lambda part: part["judged"]["gold"]["base"],
    "gold_gained": lambda part: part["judged"]["gold"]["policy"] - part["judged"]["gold"]["base"],
    "proxy": lambda part: part["judged"]["proxy"]["policy"],
    "repetition": lambda part: part["repetition"],
    "iterations": lambda part: part["iterations"],
    "cpu_s": lambda part: part["cpu_s"],
}
"""Of a learner, on prompts held out."""


def command(base: Path, out: Path, seed: int, learners: str, settings: Sequence[str]) -> list[str]:
    words = ["thorndike", "language", "demo", "--base", str(base), "--out", str(out), "--learners", learners, "--seed", str(seed)]
    return [*words, *(word for setting in settings for word in ("--set", setting))]


def without_texts(report: Found) -> dict[str, object]:
    """The figures of a report: the reviews are not ours to pass on."""
    return {name: _without(part) for name, part in report.items()}


def _without(part: object) -> object:
    return {name: value for name, value in part.items() if name != "samples"} if isinstance(part, dict) else part


def together(reports: Sequence[Found]) -> dict[str, object]:
    """Means over seeds."""
    found: dict[str, object] = {}
    for name in LEARNERS:
        parts = [cast(dict, report[name]) for report in reports if name in report]
        if parts:
            found[name] = {figure: over_seeds([of(part) for part in parts]) for figure, of in FIGURES.items()}
    for kind, part, figure in (("labels", "labels", "dawid_skene"), ("reward", "reward", "accuracy")):
        found[kind] = over_seeds([cast(dict, report[part])[figure] for report in reports])
    free = [cast(dict, report["ppo_without_kl"]) for report in reports if "ppo_without_kl" in report]
    if free:
        found["over_optimisation"] = {
            "highest_proxy": over_seeds([float(smoothed(part, "score").max()) for part in free]),
            "peak_gold": over_seeds([float(smoothed(part, "gold").max()) for part in free]),
            "final_gold_by_peak": over_seeds([FIGURES["gold"](part) / smoothed(part, "gold").max() for part in free]),
        }
        stopped = [
            FIGURES["gold"](cast(dict, report["ppo_max_kl"])) / smoothed(cast(dict, report["ppo_without_kl"]), "gold").max()
            for report in reports if "ppo_max_kl" in report and "ppo_without_kl" in report
        ]  # fmt: skip
        if stopped:
            cast(dict, found["over_optimisation"])["stopped_gold_by_peak"] = over_seeds(stopped)
    return found


def over_seeds(values: Sequence[float]) -> dict[str, object]:
    """Mean, Student's interval of it, and what it is the mean of."""
    mean, number = float(np.mean(values)), len(values)
    half = STUDENT[number] * float(np.std(values, ddof=1)) / number**0.5 if number > 1 else None
    return {"mean": mean, "ci95": None if half is None else [mean - half, mean + half], "per_seed": [float(value) for value in values]}


def smoothed(part: dict, figure: str) -> np.ndarray:
    """A curve's moving mean."""
    values = [point[figure] for point in part["curve"]]
    return np.convolve(values, np.full(min(SMOOTH, len(values)), 1 / min(SMOOTH, len(values))), "valid")


def table(reports: Sequence[Found]) -> str:
    lines = ["| learner | seed | wins against the base [95 %] | nats a text | gold, base -> policy | proxy | repetition | CPU-s |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for name in LEARNERS:
        for report in reports:
            if name in report:
                lines.append(_line(name, cast(int, report["seed"]), cast(dict, report[name])))
    return "\n".join(lines)


def means(summary: Found) -> str:
    """The same over seeds."""
    lines = [
        "| learner | seeds | wins against the base | nats a text | gold gained | proxy | repetition | CPU-s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in LEARNERS:
        if name in summary:
            part = cast(dict, summary[name])
            seeds = len(part["kl"]["per_seed"])
            figures = [in_words(part[figure], form) for figure, form in (
                ("win_rate", ".1%"), ("kl", ".1f"), ("gold_gained", ".2f"), ("proxy", ".2f"), ("repetition", ".2f"), ("cpu_s", ".0f"),
            )]  # fmt: skip
            lines.append(f"| {name} | {seeds} | {' | '.join(figures)} |")
    for name in ("labels", "reward", *cast(dict, summary.get("over_optimisation", {}))):
        part = cast(dict, summary.get(name) or cast(dict, summary["over_optimisation"])[name])
        lines.append(f"{name}: {in_words(part, '.3f')}, {', '.join(format(value, '.3f') for value in part['per_seed'])}")
    return "\n".join(lines)


def in_words(part: dict, form: str) -> str:
    interval = "" if part["ci95"] is None else f" [{part['ci95'][0]:{form}}, {part['ci95'][1]:{form}}]"
    return f"{part['mean']:{form}}{interval}"


def _line(name: str, seed: int, part: dict) -> str:
    gold, proxy = part["judged"]["gold"], part["judged"]["proxy"]
    low, high = gold["win_rate_ci95"]
    wins = f"{gold['win_rate']:.1%} [{low:.1%}, {high:.1%}]"
    figures = f"{part['kl']:.1f} | {gold['base']:.2f} -> {gold['policy']:.2f} | {proxy['policy']:.2f} | {part['repetition']:.2f}"
    return f"| {name} | {seed} | {wins} | {figures} | {part['cpu_s']:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=[11, 12, 13, 14, 15])
    parser.add_argument("--learners", default=",".join(LEARNERS))
    parser.add_argument("--runs", type=Path, default=Path("runs/demo"))
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--collect", action="store_true", help="run nothing: the figures of the runs as they are")
    parser.add_argument("--tables", action="store_true")
    options = parser.parse_args()
    if not options.tables:
        reports, commands = [], []
        for seed in options.seeds:
            out = options.runs / str(seed)
            words = command(options.base, out, seed, options.learners, options.settings)
            if not options.collect:
                subprocess.run([sys.executable, "-m", *words], check=True)
            commands.append(" ".join(words))
            stages = {path.stem: json.loads(path.read_text()) for path in sorted((out / "stages").glob("*.json"))}
            reports.append(without_texts({"seed": seed, **stages}))
            commit = json.loads((out / "run.json").read_text())["git_commit"]
            RESULTS.parent.mkdir(parents=True, exist_ok=True)
            content = {"commands": commands, "git_commit": commit, "seeds": options.seeds[: len(reports)]}
            content |= {"together": together(reports), "reports": reports}
            RESULTS.write_text(json.dumps(content, indent=1) + "\n")
    found = json.loads(RESULTS.read_text())
    print(table(found["reports"]))
    print(means(found["together"]))


if __name__ == "__main__":
    main()
