"""The demo over seeds: `python benchmarks/language_demo.py --base MODEL [--seeds 5] [--learners ppo,grpo,rloo,dpo,ppo_without_kl]`.

Runs `thorndike language demo` once a seed into --runs, or goes on with what is there, and writes benchmarks/results/language/demo.json: the
commands, and every figure of the reports, without the texts. `--tables` only prints the table of docs/rlhf.md.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

RESULTS = Path(__file__).parent / "results" / "language" / "demo.json"
LEARNERS = ("ppo", "grpo", "rloo", "dpo", "ppo_without_kl", "ppo_max_kl")
Found = Mapping[str, object]


def command(base: Path, out: Path, seed: int, learners: str, settings: Sequence[str]) -> list[str]:
    words = ["thorndike", "language", "demo", "--base", str(base), "--out", str(out), "--learners", learners, "--seed", str(seed)]
    return [*words, *(word for setting in settings for word in ("--set", setting))]


def without_texts(report: Found) -> dict[str, object]:
    """The figures of a report: the reviews are not ours to pass on."""
    return {name: _without(part) for name, part in report.items()}


def _without(part: object) -> object:
    return {name: value for name, value in part.items() if name != "samples"} if isinstance(part, dict) else part


def table(reports: Sequence[Found]) -> str:
    lines = ["| learner | seed | wins against the base [95 %] | nats a text | gold, base -> policy | proxy | repetition |"]
    lines.append("|---|---|---|---|---|---|---|")
    for name in LEARNERS:
        for report in reports:
            if name in report:
                lines.append(_line(name, cast(int, report["seed"]), cast(dict, report[name])))
    return "\n".join(lines)


def _line(name: str, seed: int, part: dict) -> str:
    gold, proxy = part["judged"]["gold"], part["judged"]["proxy"]
    low, high = gold["win_rate_ci95"]
    wins = f"{gold['win_rate']:.1%} [{low:.1%}, {high:.1%}]"
    figures = f"{part['kl']:.1f} | {gold['base']:.2f} -> {gold['policy']:.2f} | {proxy['policy']:.2f} | {part['repetition']:.2f}"
    return f"| {name} | {seed} | {wins} | {figures} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--base", type=Path)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3, 4, 5])
    parser.add_argument("--learners", default=",".join(LEARNERS))
    parser.add_argument("--runs", type=Path, default=Path("runs/demo"))
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--tables", action="store_true")
    options = parser.parse_args()
    if not options.tables:
        reports, commands = [], []
        for seed in options.seeds:
            out = options.runs / str(seed)
            words = command(options.base, out, seed, options.learners, options.settings)
            subprocess.run([sys.executable, "-m", *words], check=True)
            commands.append(" ".join(words))
            reports.append(without_texts(json.loads((out / "report.json").read_text())))
        RESULTS.parent.mkdir(parents=True, exist_ok=True)
        RESULTS.write_text(json.dumps({"commands": commands, "reports": reports}, indent=1) + "\n")
    print(table(json.loads(RESULTS.read_text())["reports"]))


if __name__ == "__main__":
    main()
