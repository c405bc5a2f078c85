"""What a memory is worth: PPO on CartPole-v1 without its two velocities, with a GRU and without, ten seeds each.

python benchmarks/memory.py             both (half an hour of CPU), into benchmarks/results/memory.json
python benchmarks/memory.py --steps 2000 a look at whether it runs
"""

import argparse
import json
from pathlib import Path

import thorndike as td

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "memory.json"
SEEDS, STEPS = 10, 500_000
SETTINGS = {"n_steps": 32, "batch_size": 128, "n_epochs": 8, "learning_rate": "linear(1e-3, 0)", "net_arch": (32,)}
VARIANTS = {"gru": {"memory": "gru", "memory_size": 32}, "none": {}}


def measure(memory: str, steps: int, output: Path) -> dict:
    """Train ten seeds that see position and angle only, and evaluate their final greedy policies."""
    settings = SETTINGS | VARIANTS[memory]
    seen = [td.wrappers.select_observation([0, 2]), td.wrappers.normalize_reward(0.99)]
    run = td.train(
        "ppo", "CartPole-v1", steps=steps, seeds=SEEDS, num_envs=16, preset="none", settings=settings, wrappers=seen,
        output=output, name=f"memory-{memory}", command="python benchmarks/memory.py",
    )  # fmt: skip
    found = td.load(run.run).evaluate(100, seed=0)
    facts = json.loads((run.run / "run.json").read_text())
    told = {"mean": found.mean, "iqm": found.iqm, "min": found.min, "ci95": found.ci95, "per_seed": found.per_seed, "cpu_s": run.cpu_s}
    made = {"config": facts["config"], "commit": facts["git_commit"], "versions": facts["versions"]}
    return {"memory": memory, "steps": run.steps, "seeds": SEEDS, **told, **made}


def main() -> None:
    """Measure both, print and keep what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=STEPS)
    options = parser.parse_args()
    rows = [measure(memory, options.steps, ROOT / "runs") for memory in VARIANTS]
    for row in rows:
        print(
            f"memory {row['memory']}: IQM {row['iqm']:.1f}, mean {row['mean']:.1f}, worst seed {row['min']:.1f}, {row['cpu_s']:.0f} CPU-s"
        )
    if options.steps == STEPS:
        RESULT.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
