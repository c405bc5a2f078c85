"""What hindsight is worth: DQN on 25 bits to flip, with and without; SAC on FetchReach.

python benchmarks/goals.py                both, into benchmarks/results/goals.json (a row each; other rows stay)
python benchmarks/goals.py bits           BitFlip-v0 alone (two CPU-minutes)
python benchmarks/goals.py fetch          FetchReach-v4 alone; needs gymnasium-robotics and mujoco 3.5.0
python benchmarks/goals.py bits --steps 8000   a look at whether it runs
"""

import argparse
import importlib.metadata
import json
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np

import thorndike as td

ROOT = Path(__file__).parents[1]
RESULT = ROOT / "benchmarks" / "results" / "goals.json"
EPISODES = 100
BITS = {
    "learning_rate": 1e-3,
    "buffer_size": 200_000,
    "batch_size": 128,
    "train_freq": 4,
    "gradient_steps": 1,
    "net_arch": (256,),
    "gamma": 0.98,
    "target_update_interval": 500,
    "exploration_fraction": 0.3,
}
FETCH = {"learning_rate": 1e-3, "gamma": 0.95, "tau": 0.05, "batch_size": 256, "learning_starts": 1000, "net_arch": (64, 64)}


class Case(NamedTuple):
    """One learner on one environment."""

    name: str
    group: str
    algorithm: str
    environment: str
    env_kwargs: dict[str, object]
    settings: dict[str, object]
    steps: int
    seeds: int


CASES = (
    Case("DQN", "bits", "dqn", "BitFlip-v0", {"bits": 25}, BITS, 100_000, 2),
    Case("DQN + HER", "bits", "dqn", "BitFlip-v0", {"bits": 25}, BITS | {"goal_selection_strategy": "future"}, 100_000, 2),
    Case("SAC + HER", "fetch", "sac", "FetchReach-v4", {}, FETCH | {"goal_selection_strategy": "future"}, 20_000, 3),
)


def measure(case: Case, steps: int | None) -> dict:
    """Train with these settings, play the final greedy policies, and count the episodes that end at their goal."""
    run = td.train(
        case.algorithm, case.environment, steps=steps or case.steps, seeds=case.seeds, preset="none", settings=case.settings,
        env_kwargs=case.env_kwargs, output=ROOT / "runs", name="goals", command=f"python benchmarks/goals.py {case.group}",
    )  # fmt: skip
    policy = td.load(run.run)
    success = _bits(policy) if case.group == "bits" else [_robot(case.environment, agent) for agent in policy.seeds]
    facts = json.loads((run.run / "run.json").read_text())
    told = {"name": case.name, "algorithm": case.algorithm, "environment": case.environment, "env_kwargs": case.env_kwargs}
    told |= {"steps": run.steps, "seeds": case.seeds, "episodes": EPISODES, "success": float(np.mean(success)), "per_seed": success}
    told |= {"cpu_s": run.cpu_s, "command": f"python benchmarks/goals.py {case.group}", "config": facts["config"]}
    if case.group == "fetch":
        told["mujoco"] = importlib.metadata.version("mujoco")
    return told | {"commit": facts["git_commit"], "versions": facts["versions"]}


def _bits(policy: td.LoadedPolicy) -> list[float]:
    """Only the goal terminates an episode."""
    # Few environments, because each of the reference kind compiles itself.
    rows = policy.evaluate(EPISODES, seed=0, num_envs=2).rows
    return [float(np.mean([row.terminated for row in rows if row.seed == seed])) for seed in range(len(policy.seeds))]


def _robot(environment: str, policy: td.LoadedPolicy) -> float:
    """Whether the robot is at its goal when time is up."""
    env = gymnasium.make(environment)
    reached = []
    for episode in range(EPISODES):
        obs, _ = env.reset(seed=10_000 + episode)
        done, memory = False, None
        while not done:
            action, memory = policy.predict(obs, memory)
            obs, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
        reached.append(float(info["is_success"]))
    env.close()
    return float(np.mean(reached))


def main() -> None:
    """Measure what is asked for, print and keep what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("group", nargs="?", choices=("bits", "fetch"))
    parser.add_argument("--steps", type=int)
    options = parser.parse_args()
    kept = {row["name"] + row["environment"]: row for row in json.loads(RESULT.read_text())} if RESULT.exists() else {}
    for case in CASES:
        if options.group not in (None, case.group):
            continue
        row = measure(case, options.steps)
        rates = ", ".join(f"{100 * rate:.0f}" for rate in row["per_seed"])
        print(
            f"{case.name} on {case.environment}: {100 * row['success']:.1f} % of goals reached (seeds: {rates}), {row['cpu_s']:.0f} CPU-s",
            flush=True,
        )
        kept[case.name + case.environment] = row
        if options.steps is None:
            RESULT.write_text(json.dumps(list(kept.values()), indent=1) + "\n")


if __name__ == "__main__":
    main()
