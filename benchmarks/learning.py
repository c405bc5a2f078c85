"""The learning bars: ten seeds, the final policy, a hundred fresh Gymnasium episodes each; results as JSON and in the docs' tables.

python benchmarks/learning.py                       every bar (hours of CPU)
python benchmarks/learning.py ppo CartPole-v1       one of them
python benchmarks/learning.py --record RUN          evaluate and write down a run that exists
python benchmarks/learning.py --tables              only write the tables from the JSON files
"""

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import thorndike as td
from thorndike.statistics import summary

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "learning"
SEEDS = 10


class Bar(NamedTuple):
    """What REFERENCE asks of one algorithm on one environment."""

    algorithm: str
    environment: str
    statistic: str
    """``iqm`` or ``mean``, over the seeds' means."""
    at_least: float
    worst: float | None = None
    """What the worst seed must reach, if anything."""
    episodes: int = 100


BARS = (
    Bar("ppo", "CartPole-v1", "iqm", 495, worst=475),
    Bar("ppo", "Pendulum-v1", "mean", -185),
    Bar("ppo", "LunarLander-v3", "mean", 235),
    Bar("ppo", "MinAtar/Asterix-v0", "iqm", 15, episodes=30),
    Bar("ppo", "MinAtar/Breakout-v0", "iqm", 28, episodes=30),
    Bar("ppo", "MinAtar/SpaceInvaders-v0", "iqm", 131, episodes=30),
    Bar("ppo", "MinAtar/Freeway-v0", "iqm", 58, episodes=30),
    Bar("a2c", "CartPole-v1", "iqm", 490),
    Bar("a3c", "CartPole-v1", "iqm", 490),
    Bar("impala", "CartPole-v1", "iqm", 490),
    Bar("trpo", "CartPole-v1", "iqm", 490),
    Bar("reinforce", "CartPole-v1", "iqm", 475),
    Bar("dqn", "CartPole-v1", "iqm", 490),
    Bar("dqn", "Acrobot-v1", "mean", -82),
    Bar("dqn", "MountainCar-v0", "iqm", -110),
    Bar("dqn", "LunarLander-v3", "mean", 200),
    Bar("sac", "Pendulum-v1", "mean", -165),
    Bar("sac", "MountainCarContinuous-v0", "mean", 93),
    Bar("sac", "InvertedPendulum-v5", "mean", 1000),
    Bar("td3", "Pendulum-v1", "mean", -165),
    Bar("ddpg", "Pendulum-v1", "mean", -165),
    Bar("tqc", "Pendulum-v1", "mean", -165),
    Bar("qr_dqn", "CartPole-v1", "iqm", 490),
    Bar("qr_dqn", "Acrobot-v1", "mean", -78),
    Bar("rainbow", "CartPole-v1", "iqm", 490),
    Bar("pqn", "CartPole-v1", "iqm", 490),
    Bar("muzero", "CartPole-v1", "mean", 475),
    Bar("q_learning", "FrozenLake-v1", "mean", 0.70, episodes=1000),
    Bar("q_learning", "Taxi-v4", "mean", 7.8, episodes=1000),
    Bar("q_learning", "CliffWalking-v1", "mean", -13, worst=-13),
    Bar("q_learning", "Blackjack-v1", "mean", -0.0531, episodes=100_000),
    Bar("q_learning", "CartPole-v1", "mean", 475),
)


def measure(bar: Bar, output: Path = ROOT / "runs") -> dict:
    """Train with the preset and evaluate."""
    result = td.train(
        bar.algorithm, bar.environment, seeds=SEEDS, seed=0, output=output, name="bar",
        command=f"thorndike train {bar.algorithm} {bar.environment} --seeds {SEEDS} --seed 0",
    )  # fmt: skip
    return record(bar, result.run)


def record(bar: Bar, run: Path) -> dict:
    """Evaluate a run and describe what was found, and whether the bar holds."""
    facts = json.loads((run / "run.json").read_text())
    if facts["status"] != "finished":
        raise SystemExit(f"{run} is {facts['status']}, not finished: there is no result to write down")
    found = td.load(run).evaluate(bar.episodes, seed=0)
    by_seed = [[row.total for row in found.rows if row.seed == seed] for seed in range(facts["seeds"])]
    value = getattr(found, bar.statistic)
    return {
        "bar": bar._asdict(),
        "met": value >= bar.at_least and (bar.worst is None or found.min >= bar.worst),
        "steps": facts["steps_done"],
        "seeds": facts["seeds"],
        "episodes": found.episodes,
        "mean": found.mean,
        "iqm": found.iqm,
        "min": found.min,
        "ci95": found.ci95,
        "iqm_ci95": summary(by_seed).iqm_ci95,
        "per_seed": found.per_seed,
        "train": f"thorndike train {bar.algorithm} {bar.environment} --seeds {facts['seeds']} --seed {facts['seed']}",
        "evaluate": f"thorndike eval RUN --episodes {found.episodes} --seed 0",
        "config": facts["config"],
        "num_envs": facts["num_envs"],
        "engine": facts["engine"],
        "wall_s": facts["wall_s"],
        "cpu_s": facts["cpu_s"],
        "commit": facts["git_commit"],
        "versions": facts["versions"],
        "platform": facts["platform"],
    }


def write(content: dict) -> Path:
    """Write one bar's result."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    bar = content["bar"]
    path = RESULTS / f"{bar['algorithm']}-{bar['environment'].replace('/', '-')}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    return path


def tables() -> None:
    """Write the tables of the README and of the algorithms' pages from the JSON files."""
    results = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    pages = ("ppo", "trpo", "a2c", "a3c", "impala", "reinforce", "dqn", "rainbow", "qr_dqn", "pqn")
    for algorithm in (*pages, "sac", "td3", "ddpg", "tqc", "crossq", "redq"):
        own = [result for result in results if result["bar"]["algorithm"] == algorithm]
        head = ["environment", "steps", "mean", "IQM", "worst seed", "95 % interval of the mean", "bar", "CPU-s, 10 seeds", "command"]
        _replace(ROOT / "docs" / "algorithms" / f"{algorithm}.md", [head, *(_row(result) for result in own)])
    head = ["learner", "environment", "steps", "mean", "worst seed", "bar", "command"]
    _replace(ROOT / "README.md", [head, *(_short_row(result) for result in results)])


def _row(result: dict) -> list[str]:
    low, high = result["ci95"]
    numbers = [_number(result["mean"]), _number(result["iqm"]), _number(result["min"]), f"{_number(low)} to {_number(high)}"]
    name = result["bar"]["environment"]
    return [name, f"{result['steps']:,}", *numbers, _bar(result), f"{result['cpu_s']:,.0f}", f"`{result['train']}`"]


def _short_row(result: dict) -> list[str]:
    bar = result["bar"]
    numbers = [_number(result["mean"]), _number(result["min"]), _bar(result)]
    return [bar["algorithm"], bar["environment"], f"{result['steps']:,}", *numbers, f"`{result['train']}`"]


def _bar(result: dict) -> str:
    bar = result["bar"]
    worst = "" if bar["worst"] is None else f", worst >= {bar['worst']:g}"
    return f"{bar['statistic']} >= {bar['at_least']:g}{worst}: {'met' if result['met'] else '**not met**'}"


def _number(value: float) -> str:
    return f"{value:.4f}" if abs(value) < 10 else f"{value:.1f}"


def _replace(path: Path, rows: list[list[str]]) -> None:
    start, end = "<!-- results:start -->", "<!-- results:end -->"
    text = path.read_text()
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---" * len(rows[0]) + "|")
    before, after = text.split(start)[0], text.split(end)[1]
    path.write_text(before + start + "\n" + "\n".join(lines) + "\n" + end + after)


def main() -> int:
    """Measure what is asked for; exit status 1 if a bar is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="ALGORITHM ENVIRONMENT")
    parser.add_argument("--record", type=Path, metavar="RUN", help="evaluate this finished run instead of training")
    parser.add_argument("--tables", action="store_true", help="only write the tables")
    options = parser.parse_args()
    failed = False
    for bar in () if options.tables else _chosen(options):
        content = record(bar, options.record) if options.record else measure(bar)
        print(write(content), _bar(content), f"mean {content['mean']:.4g} iqm {content['iqm']:.4g} worst {content['min']:.4g}", flush=True)
        failed |= not content["met"]
    tables()
    return int(failed)


def _chosen(options: argparse.Namespace) -> list[Bar]:
    names = options.names
    if options.record:
        facts = json.loads((options.record / "run.json").read_text())
        names = [facts["algorithm"], facts["environment"]]
    return [bar for bar in BARS if not names or list(bar[:2]) == names]


if __name__ == "__main__":
    sys.exit(main())
