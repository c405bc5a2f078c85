"""Learning from datasets of our own, ten seeds each, and estimates of a policy's worth beside the true one.

python benchmarks/offline.py            make agents, datasets and the table: benchmarks/results/offline.json (about 20 CPU-minutes)
python benchmarks/offline.py --tables   write the tables of docs/offline.md from it
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import thorndike as td
from thorndike.training.datasets import episodes_of

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "offline.json"
DOCS = ROOT / "docs" / "offline.md"
SEEDS, EPISODES, UPDATES = 10, 10, 4_000
SIZES = {"net_arch": (64, 64), "batch_size": 128, "learning_rate": 1e-3}


class Task(NamedTuple):
    """An environment, the agent that records on it, and who learns from that."""

    environment: str
    agent: str
    settings: dict
    medium_steps: int
    expert_steps: int
    mixture: tuple[int, int, int]
    """Steps of random, medium and expert actions."""
    learners: dict[str, dict]


TASKS = (
    Task(
        "Pendulum-v1",
        "sac",
        {"net_arch": (64, 64), "learning_rate": 1e-3, "learning_starts": 500},
        3_000,
        15_000,
        (10_000, 8_000, 2_000),
        {"bc": {}, "iql": {"temperature": 3.0, "expectile": 0.9}, "td3_bc": {}, "cql": {"n_actions": 4, "alpha": 1.0}},
    ),
    Task(
        "CartPole-v1",
        "ppo",
        {},
        10_000,
        100_000,
        (8_000, 6_000, 2_000),
        {"bc": {}, "iql": {"temperature": 1.0, "expectile": 0.9}, "cql": {"alpha": 1.0}},
    ),
)


def make_datasets(task: Task, folder: Path) -> tuple[dict[str, str], dict[str, Path]]:
    """Runs of the agents and datasets of their steps, by name."""
    agents = {
        level: td.train(task.agent, task.environment, steps=steps, settings=task.settings, preset="none", output=folder / "runs").run
        for level, steps in (("medium", task.medium_steps), ("expert", task.expert_steps))
    }
    places = {}
    for name, agent, share in (("random", "medium", 1.0), ("medium", "medium", 0.0), ("expert", "expert", 0.0)):
        places[name] = td.record(
            agents[agent], steps=sum(task.mixture), random_share=share, to=folder / task.environment / f"{name}-v0"
        ).path
    parts = []
    for number, (name, agent, share) in enumerate((("random", "medium", 1.0), ("medium", "medium", 0.0), ("expert", "expert", 0.0))):
        to = folder / task.environment / f"part-{name}-v0"
        parts.append(td.record(agents[agent], steps=task.mixture[number], random_share=share, seed=1, to=to).path)
    places["mixed"] = td.mix(*parts, to=folder / task.environment / "mixed-v0").path
    return agents, places


def score(task: Task, places: dict[str, Path], folder: Path) -> list[dict]:
    """A row a dataset: its own returns, and what each learner makes of it."""
    rows = []
    for name, place in places.items():
        data = td.dataset(place)
        row = {"environment": task.environment, "dataset": name, "steps": len(data.reward), "episodes": len(data.lengths)}
        row |= {"behavior": float(data.returns.mean()), "best_episode": float(data.returns.max()), "learners": {}}
        for learner, settings in task.learners.items():
            made = td.train(learner, str(place), steps=UPDATES, seeds=SEEDS, settings=SIZES | settings, output=folder / "runs")
            found = td.load(made.run).evaluate(EPISODES)
            row["learners"][learner] = {
                "mean": found.mean,
                "iqm": found.iqm,
                "min": found.min,
                "ci95": found.ci95,
                "per_seed": found.per_seed,
            }
            row["learners"][learner] |= {"settings": SIZES | settings, "updates": UPDATES, "cpu_s": made.cpu_s}
            print(f"{task.environment} {name} {learner}: {found.mean:.1f} ({made.cpu_s:.0f} CPU-s)", file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def judge(agents: dict[str, Path], folder: Path) -> list[dict]:
    """Estimates of the medium CartPole policy's worth from ten datasets of its noisy twin, beside the true worth."""
    gamma, rows = 0.9, []
    alone = td.record(agents["medium"], episodes=200, deterministic=True, seed=100, to=folder / "alone-v0")
    true = discounted(alone, gamma).mean()
    for seed in range(10):
        data = td.record(agents["medium"], episodes=200, deterministic=True, random_share=0.2, seed=seed, to=folder / f"noisy-v{seed}")
        found = td.evaluate_offline(agents["medium"], data, gamma=gamma, steps=3_000, seed=seed)
        estimates = {name: each.value for name, each in found.estimates.items()}
        rows.append({"effective_episodes": found.effective_episodes, "behavior": found.behavior.value, "estimates": estimates})
    errors = {}
    for name in ("behavior", *rows[0]["estimates"]):
        values = np.array([row["behavior"] if name == "behavior" else row["estimates"][name] for row in rows])
        errors[name] = {"bias": float((values - true).mean()), "rmse": float(np.sqrt(np.square(values - true).mean()))}
    return [{"environment": "CartPole-v1", "gamma": gamma, "true": float(true), "logs": rows, "errors": errors}]


def discounted(data, gamma: float) -> np.ndarray:
    return np.array([float((part.reward * gamma ** np.arange(len(part.reward))).sum()) for part in episodes_of(data)])


def write_tables() -> None:
    content = json.loads(RESULTS.read_text())
    lines = [
        "| environment | dataset | its own return | " + " | ".join(["bc", "td3_bc", "iql", "cql"]) + " |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in content["learning"]:
        cells = [cell(row["learners"].get(name)) for name in ("bc", "td3_bc", "iql", "cql")]
        lines.append(f"| {row['environment']} | {row['dataset']} | {row['behavior']:.0f} | {' | '.join(cells)} |")
    put("learning", lines)
    for found in content["evaluation"]:
        head = f"True value {found['true']:.3f} (gamma {found['gamma']}), ten datasets of 200 episodes:"
        rows = [f"| {name} | {each['bias']:+.3f} | {each['rmse']:.3f} |" for name, each in found["errors"].items()]
        put("evaluation", [head, "", "| estimate | bias | root mean squared error |", "|---|---|---|", *rows])


def cell(found: dict | None) -> str:
    if found is None:
        return "-"
    low, high = found["ci95"]
    return f"{found['mean']:.0f} ({low:.0f} to {high:.0f})"


def put(name: str, lines: list[str]) -> None:
    text = DOCS.read_text()
    before, _, rest = text.partition(f"<!-- {name} -->\n")
    after = rest.partition(f"<!-- end of {name} -->")[2]
    DOCS.write_text(f"{before}<!-- {name} -->\n" + "\n".join(lines) + f"\n<!-- end of {name} -->{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", action="store_true")
    if parser.parse_args().tables:
        return write_tables()
    learning, evaluation, begun = [], [], time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for task in TASKS:
            agents, places = make_datasets(task, folder)
            if task.environment == "CartPole-v1":
                evaluation = judge(agents, folder / "judged")
            learning += score(task, places, folder)
    content = {"seeds": SEEDS, "episodes": EPISODES, "cpu_s": time.process_time() - begun}
    RESULTS.write_text(json.dumps(content | {"learning": learning, "evaluation": evaluation}, indent=1) + "\n")
    return None


if __name__ == "__main__":
    main()
