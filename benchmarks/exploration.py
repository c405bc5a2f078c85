"""Exploration, measured: which learners find a reward that random actions do not.

    .venv/bin/python benchmarks/exploration.py deep_sea     # bootstrapped DQN with priors, and DQN with epsilon, on DeepSea of size 20
    .venv/bin/python benchmarks/exploration.py bonuses      # PPO with random network distillation and alone, on size 10
    .venv/bin/python benchmarks/exploration.py --tables     # only write the tables of docs/exploration.md

Each writes benchmarks/results/exploration/<task>.json: the final greedy policies on fresh reference environments, the mean training return
of every seed at every log point, and the commands. A seed has *found* the reward at the first log point whose mean training return is above
the task's threshold.
"""

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import thorndike as td

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "exploration"
EPISODES = 100


class Contestant(NamedTuple):
    """One learner, in the words of the command line."""

    name: str
    algorithm: str
    words: str


class Task(NamedTuple):
    """What all contestants try."""

    environment: str
    words: str
    threshold: float
    """A mean training return above it means that the reward has been found."""
    contestants: tuple[Contestant, ...]


SIZES = "--set net_arch=32,32 --set batch_size=64 --set buffer_size=28000"
DEEP = f"{SIZES} --set train_freq=4 --set target_update_interval=16 --set learning_rate=1e-3"
PPO = "--steps 60k --seeds 5 --num-envs 16 --set n_steps=50 --set batch_size=200 --set ent_coef=0.01 --set learning_rate=1e-3"
TASKS = {
    "deep_sea": Task(
        "DeepSea-v0",
        "--env-set size=20 --steps 28k --seeds 10 --num-envs 4",
        0.5,
        (
            Contestant("bootstrapped DQN with priors", "bootstrapped_dqn", f"{DEEP} --set prior_scale=20 --set double=false"),
            Contestant("DQN, epsilon-greedy", "dqn", f"{DEEP} --set exploration_fraction=0.5"),
        ),
    ),
    "bonuses": Task(
        "DeepSea-v0",
        f"--env-set size=10 {PPO}",
        0.5,
        (
            Contestant("PPO with random network distillation", "ppo", "--wrap random_network_distillation"),
            Contestant("PPO alone", "ppo", ""),
        ),
    ),
}


def measure(task: Task, contestant: Contestant, output: Path) -> dict:
    """Train by the command line, evaluate, and say when each seed found the reward."""
    command = f"thorndike train {contestant.algorithm} {task.environment} {task.words} {contestant.words}".strip()
    words = [sys.executable, "-m", *shlex.split(command), "--output", str(output), "--json"]
    answer = json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    facts = json.loads((Path(answer["run"]) / "run.json").read_text())
    lines = (Path(answer["run"]) / "metrics.jsonl").read_text().splitlines()
    curve = [(point["steps"], point["rollout/ep_rew_mean"]) for point in map(json.loads, lines)]
    found = td.load(answer["run"]).evaluate(EPISODES, seed=0)
    return {
        "name": contestant.name,
        "train": command,
        "steps": answer["steps"],
        "seeds": answer["seeds"],
        "cpu_s": answer["cpu_s"],
        "wall_s": answer["wall_s"],
        "found_at": [_found_at(curve, seed, task.threshold) for seed in range(answer["seeds"])],
        "episodes": EPISODES,
        "per_seed": found.per_seed,
        "mean": found.mean,
        "min": found.min,
        "ci95": found.ci95,
        "curve": curve,
        **{name: facts[name] for name in ("engine", "config", "wrappers", "git_commit", "versions", "platform")},
    }


def _found_at(curve: list[tuple[int, list[float | None]]], seed: int, threshold: float) -> int | None:
    return next((steps for steps, means in curve if (means[seed] or 0.0) > threshold), None)


def tables() -> None:
    """Write the tables of docs/exploration.md from the JSON files."""
    path = ROOT / "docs" / "exploration.md"
    text = path.read_text()
    for name in TASKS:
        file, start, end = RESULTS / f"{name}.json", f"<!-- {name}:start -->", f"<!-- {name}:end -->"
        if file.is_file() and start in text:
            rows = [_row(result) for result in json.loads(file.read_text())["results"]]
            head = "| learner | steps | seeds that found it | median steps until then | final policy: mean, worst seed | CPU-s | command |"
            before, after = text.split(start)[0], text.split(end)[1]
            text = before + start + "\n" + "\n".join([head, "|---" * 7 + "|", *rows]) + "\n" + end + after
    path.write_text(text)


def _row(result: dict) -> str:
    found = sorted(steps for steps in result["found_at"] if steps is not None)
    after = f"{found[len(found) // 2]:,}" if found else "never"
    judged = f"{result['mean']:.3f}, {result['min']:.3f}"
    share = f"{len(found)} of {result['seeds']}"
    return f"| {result['name']} | {result['steps']:,} | {share} | {after} | {judged} | {result['cpu_s']:,.0f} | `{result['train']}` |"


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", choices=TASKS)
    parser.add_argument("--output", type=Path, default=ROOT / "runs", help="where the runs are made")
    parser.add_argument("--tables", action="store_true", help="only write the tables")
    options = parser.parse_args()
    chosen = {} if options.tables else {name: task for name, task in TASKS.items() if options.task in (None, name)}
    for name, task in chosen.items():
        results = []
        for contestant in task.contestants:
            results.append(measure(task, contestant, options.output))
            print(_row(results[-1]), flush=True)
            RESULTS.mkdir(parents=True, exist_ok=True)
            content = {"environment": task.environment, "threshold": task.threshold, "results": results}
            (RESULTS / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n")
    tables()


if __name__ == "__main__":
    main()
