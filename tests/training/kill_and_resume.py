"""Kill runs with SIGKILL at random moments, resume them, and compare them with runs that nothing happened to.

    python tests/training/kill_and_resume.py --kills 50

For each case (a learner, compiled or on host environments) a run is made that is not disturbed. Then runs with the same seed are killed,
resumed, and killed again; after each kill every checkpoint there is compared with its manifest. When a run has come to its end, its
checkpoints, metrics and policy are compared with the first one's, bit for bit. One line a case; exit status 1 if anything differed, or
could not be read.
"""

import argparse
import json
import math
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from thorndike.training.run_directory import checkpoints, read_lines, read_run
from thorndike.training.sealed_folders import intact

ROOT = Path(__file__).parents[2]
TIMES = ("wall_s", "cpu_s", "time/fps", "time/environment", "time/acting", "time/learning", "time/waiting")
KILLS_OF_A_RUN = 5
"""Then it is let run to its end and compared."""
PPO = "--num-envs 4 --set n_steps=32 --set batch_size=64 --set n_epochs=2 --set net_arch=16"
DQN = "--num-envs 4 --set learning_starts=1000 --set buffer_size=120000 --set net_arch=16 --set train_freq=8 --preset none"
TABLE = "--num-envs 2 --set n_steps=5"


class Case(NamedTuple):
    """What is trained; seconds of training, without starting and compiling, are about 3."""

    name: str
    words: str


CASES = [
    Case("ppo native", f"ppo CartPole-v1 --steps 400k {PPO}"),
    Case("dqn native", f"dqn CartPole-v1 --steps 150k {DQN}"),
    Case("q_learning native", f"q_learning FrozenLake-v1 --steps 4M {TABLE}"),
    Case("ppo host", f"ppo CartPole-v1 --engine gymnasium --steps 40k {PPO}"),
    Case("dqn host", f"dqn CartPole-v1 --engine gymnasium --steps 24k {DQN}"),
    Case("q_learning host", f"q_learning FrozenLake-v1 --engine gymnasium --steps 12k {TABLE}"),
]


class Tally(NamedTuple):
    """What came of a case."""

    kills: int
    in_training: int
    """Kills after the first line had been logged."""
    while_saving: int
    """Kills that left a checkpoint half written."""
    runs: int
    differences: list[str]
    unreadable: int
    """Checkpoints that were not as their manifests say, after a kill."""
    lost: float
    """The most that was logged after the newest checkpoint when a run was killed, in intervals between checkpoints."""


def command(words: list[str]) -> list[str]:
    """A command line of this checkout."""
    return [sys.executable, "-m", "thorndike", *words]


def environment() -> dict[str, str]:
    """One processor, compiling quickly, this checkout's code."""
    own = {"NPROC": "1", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT / "src")}
    return {"THORNDIKE_CACHE": str(ROOT / ".cache"), **os.environ, **own}


def started(words: list[str]) -> subprocess.Popen:
    """A command under way."""
    return subprocess.Popen(command(words), env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finished(words: list[str]) -> None:
    """Run a command to its end. Raises ``RuntimeError`` if it fails."""
    process = started(words)
    _, told = process.communicate()
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(words)}: status {process.returncode}: {told[-2000:]}")


def run_below(output: Path) -> Path | None:
    """The run in a folder, once it has a run.json."""
    return next((path.parent for path in output.glob("*/*/*/run.json")), None)


def lost_steps(run: Path) -> int:
    """Steps that were logged after the newest checkpoint: those that resume makes again."""
    rows = read_lines(run / "metrics.jsonl")
    return (rows[-1]["steps"] if rows else 0) - max((int(path.name) for path in checkpoints(run)), default=0)


def interval_of(run: Path) -> int:
    """Steps between two checkpoints: what was asked for, in whole iterations."""
    newest = checkpoints(run)[-1]
    per_iteration = int(newest.name) // json.loads((newest / "progress.json").read_text())["iteration"]
    return math.ceil(read_run(run)["checkpoint_every"] / per_iteration) * per_iteration


def lines_of(run: Path | None) -> int:
    """Lines logged so far."""
    path = None if run is None else run / "metrics.jsonl"
    return path.read_bytes().count(b"\n") if path is not None and path.exists() else 0


def logged(run: Path) -> list[dict]:
    """``metrics.jsonl`` without what the clock says."""
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in row.items() if name not in TIMES} for row in rows]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a checkpoint or a policy but what the clock has a part in."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in ("manifest.json", "progress.json")}


def difference(whole: Path, other: Path) -> str | None:
    """The first thing in which two runs that have ended differ."""
    if logged(whole) != logged(other):
        return "metrics.jsonl"
    names = [sorted(path.name for path in (run / "checkpoints").iterdir()) for run in (whole, other)]
    if names[0] != names[1]:
        return f"checkpoints {names[1]} in place of {names[0]}"
    for folder in [*(f"checkpoints/{name}" for name in names[0]), "policy"]:
        ours, theirs = contents(whole / folder), contents(other / folder)
        unequal = [name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name)]
        if unequal:
            return f"{folder}: {', '.join(sorted(unequal))}"
    return None


def kill_at_random(words: list[str], output: Path, chance: random.Random, training_s: float) -> bool | None:
    """Start a command and kill it: in one of five cases at any moment, else while it trains. Whether it had logged a line by then.

    None if it came to its end before.
    """
    process = started(words)
    before, began = lines_of(run_below(output)), time.monotonic()
    anywhere, delay = chance.random() < 0.2, chance.random()
    while not anywhere and process.poll() is None and lines_of(run_below(output)) == before:
        time.sleep(0.002)
    time.sleep(delay * (training_s + 3 if anywhere else training_s))
    if process.poll() is not None:
        _, told = process.communicate()
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(words)}: status {process.returncode} after {time.monotonic() - began:.1f} s: {told[-2000:]}")
        return None
    process.kill()
    process.communicate()
    return lines_of(run_below(output)) != before


def try_case(case: Case, kills: int, chance: random.Random, folder: Path) -> Tally:
    """Kill and resume runs of a case until there were so many kills; compare each at its end."""
    train = ["train", *case.words.split()]
    finished([*train, "--output", str(folder / "whole")])
    whole = run_below(folder / "whole")
    rows = [json.loads(line) for line in (whole / "metrics.jsonl").read_text().splitlines()]
    training_s = (rows[-1]["wall_s"] - rows[0]["wall_s"]) / (KILLS_OF_A_RUN - 1)
    made, in_training, saving, runs, unreadable, lost, differences = 0, 0, 0, 0, 0, 0, []
    while made < kills:
        output = folder / f"killed-{runs}"
        for _ in range(min(KILLS_OF_A_RUN, kills - made)):
            run = run_below(output)
            hit = kill_at_random([*train, "--output", str(output)] if run is None else ["resume", str(run)], output, chance, training_s)
            run = run_below(output)
            if hit is None:
                break
            made, in_training = made + 1, in_training + hit
            saving += run is not None and (run / "checkpoints" / "partial").exists()
            if run is None:
                shutil.rmtree(output, ignore_errors=True)
                continue
            unreadable += sum(not intact(path) for path in checkpoints(run))
            lost = max(lost, lost_steps(run))
        run = run_below(output)
        finished(["resume", str(run)] if run is not None else [*train, "--output", str(output)])
        found = difference(whole, run_below(output))
        differences += [] if found is None else [f"run {runs}: {found}"]
        runs += 1
        if found is None:
            shutil.rmtree(output)
    return Tally(made, in_training, saving, runs, differences, unreadable, lost / interval_of(whole))


def main() -> int:
    """Try the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each case")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--case", action="append", choices=[case.name for case in CASES], help="only this one; may be repeated")
    parser.add_argument("--folder", type=Path, help="where the runs are made (they are removed afterwards)")
    options = parser.parse_args()
    bad = 0
    for case in CASES:
        if options.case and case.name not in options.case:
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="thorndike-kill-", dir=options.folder) as folder:
            tally = try_case(case, options.kills, random.Random(f"{options.seed} {case.name}"), Path(folder))
        bad += len(tally.differences) + tally.unreadable
        print(
            f"{case.name}: {tally.kills} kills ({tally.in_training} in training, {tally.while_saving} while saving) of {tally.runs} runs, "
            f"{len(tally.differences)} different, {tally.unreadable} unreadable checkpoints, at most {tally.lost:.2f} intervals lost, "
            f"{time.monotonic() - began:.0f} s {'; '.join(tally.differences)}",
            flush=True,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
