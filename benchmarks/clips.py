"""PPO from 500 simulated choices between clips, beside PPO on the true reward with as many steps.

    python benchmarks/clips.py                      five seeds on Pendulum-v1, without errors of the rater and with a tenth of them
    python benchmarks/clips.py --errors 0 --seeds 1 --steps 50000     a look at whether it runs
    python benchmarks/clips.py --tables             only write the table of docs/clips.md

Every seed has clips, choices, rewards and a policy of its own, and is gone on with where it was interrupted (in --runs). Each final greedy
policy plays 100 episodes on fresh reference environments. Written to benchmarks/results/clips.json.
"""

import argparse
import json
import time
from pathlib import Path

import gymnasium
import numpy as np

import thorndike as td
from machine import commit, processor
from thorndike.statistics import summary

ROOT = Path(__file__).parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results" / "clips.json", ROOT / "docs" / "clips.md"
EPISODES, CHOICES, ROUNDS = 100, 500, 5
SETTINGS = {"learning_rate": "linear(1e-3, 0)"}
"""Of both learners, beside the preset's: at its constant rate one seed on a learnt reward fell from -170 to -464 late in 200,000 steps."""
START, END = "<!-- clips:start -->", "<!-- clips:end -->"


def random_return(environment: str, episodes: int = EPISODES) -> float:
    """The mean return of uniform actions."""
    env, totals = gymnasium.make(environment), []
    env.action_space.seed(0)
    for episode in range(episodes):
        env.reset(seed=episode)
        total, done = 0.0, False
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, done = total + float(reward), terminated or truncated
        totals.append(total)
    env.close()
    return float(np.mean(totals))


def from_choices(environment: str, steps: int, seed: int, error_rate: float, runs: Path) -> dict:
    """One seed, from clips to a policy."""
    began = time.process_time()
    where = runs / f"{environment}-{steps}-{error_rate}-{seed}"
    rater = td.SimulatedRater(temperature=1.0, error_rate=error_rate)
    found = td.train_on_choices(
        "ppo", environment, where, choices=CHOICES, rounds=ROUNDS, simulated=rater, steps=steps, seed=seed, settings=SETTINGS
    )
    if found.status != "finished":
        raise SystemExit(f"seed {seed} was interrupted and is not reported: the same command goes on with it")
    spent = time.process_time() - began
    return {"seed": seed, "return": td.load(found.run).evaluate(EPISODES).mean, "held_out": found.accuracy, "cpu_s": spent}


def from_reward(environment: str, steps: int, seed: int, runs: Path) -> float:
    """The same learner on the environment's own reward."""
    kept = runs / f"{environment}-{steps}-true-{seed}.json"
    if not kept.exists():
        run = td.train("ppo", environment, steps=steps, seed=seed, settings=SETTINGS, output=runs, name=f"true-{seed}")
        kept.write_text(json.dumps(td.load(run.run).evaluate(EPISODES).mean))
    return json.loads(kept.read_text())


def measure(options: argparse.Namespace, error_rate: float, truth: list[float], by_chance: float) -> dict:
    rows = []
    for seed in range(options.seeds):
        row = from_choices(options.environment, options.steps, seed, error_rate, options.runs)
        row |= {"true_reward": truth[seed], "share": (row["return"] - by_chance) / (truth[seed] - by_chance)}
        rows.append(row)
        print({name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()}, flush=True)
    found, share = (summary(np.array([row[name] for row in rows])) for name in ("return", "share"))
    return {
        "error_rate": error_rate, "mean": found.mean, "ci95": found.ci95, "worst": found.min, "share": share.mean,
        "share_ci95": share.ci95, "share_worst": share.min, "rows": rows,
    }  # fmt: skip


def tables() -> None:
    """Write the table of the docs from the results."""
    kept, text = json.loads(RESULTS.read_text()), PAGE.read_text()
    lines = ["| learns from | mean return | each seed | share of the true reward's gain over chance: mean, worst |", "|---|---|---|---|"]
    truth = ", ".join(f"{value:.0f}" for value in kept["true_reward"])
    lines.append(f"| the true reward | {np.mean(kept['true_reward']):.1f} | {truth} | |")
    for case in kept["cases"]:
        each = ", ".join(f"{row['return']:.0f}" for row in case["rows"])
        how = f"{case['error_rate']:.0%} of them random" if case["error_rate"] else "by Bradley-Terry alone"
        rater = f"{kept['choices']} choices, {how}"
        lines.append(f"| {rater} | {case['mean']:.1f} | {each} | {case['share']:.1%}, {case['share_worst']:.1%} |")
    lines.append(f"| nothing: random actions | {kept['by_chance']:.1f} | | |")
    before, after = text.split(START)[0], text.split(END)[1]
    PAGE.write_text(before + START + "\n" + "\n".join(lines) + "\n" + END + after)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", default="Pendulum-v1")
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--errors", type=float, nargs="*", default=[0.0, 0.1])
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "clips", help="where everything is made, and gone on with")
    parser.add_argument("--tables", action="store_true", help="only write the table")
    options = parser.parse_args()
    if not options.tables:
        by_chance = random_return(options.environment)
        truth = [from_reward(options.environment, options.steps, seed, options.runs) for seed in range(options.seeds)]
        print({"by_chance": round(by_chance, 1), "true_reward": [round(value, 1) for value in truth]}, flush=True)
        command = f"python benchmarks/clips.py --errors {' '.join(f'{each:g}' for each in options.errors)}"
        about = {"command": command, "commit": commit(ROOT), "processor": processor()}
        about |= {"environment": options.environment, "steps": options.steps, "choices": CHOICES, "rounds": ROUNDS, "settings": SETTINGS}
        about |= {"episodes": EPISODES, "by_chance": by_chance, "true_reward": truth, "cases": []}
        for error_rate in options.errors:
            about["cases"].append(measure(options, error_rate, truth, by_chance))
            RESULTS.write_text(json.dumps(about, indent=1) + "\n")
    tables()


if __name__ == "__main__":
    main()
