"""Watches ``thorndike train ppo CartPole-v1`` from outside until its metrics say that the mean training return reached 475.

The moment is when the log point is in ``metrics.jsonl``, where a user can see it; CPU-seconds are the kernel's for that process (from its
start, import and compilation included), not Thorndike's own. The mean is over the last log points that together hold 100 episodes.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

TICKS = os.sysconf("SC_CLK_TCK")
LOOK_EVERY_S = 0.005


def process_cpu_s(pid: int) -> float:
    """User + system CPU-seconds of a running process and its finished children, to a clock tick."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(int(ticks) for ticks in fields[11:15]) / TICKS


def new_lines(path: Path, offset: int) -> tuple[list[str], int]:
    """Whole lines of ``path`` after ``offset``, and the offset behind them."""
    with path.open("rb") as file:
        file.seek(offset)
        text = file.read()
    whole = text[: text.rfind(b"\n") + 1]
    return whole.decode().splitlines(), offset + len(whole)


def episodes_of(point: dict, before: dict | None) -> float:
    """Episodes that ended in a log point's stretch: as it says, or else its steps over their mean length."""
    if "rollout/episodes" in point:
        return point["rollout/episodes"][0] or 0.0
    length = point.get("rollout/ep_len_mean", [None])[0]
    return (point["steps"] - (before["steps"] if before else 0)) / length if length else 0.0


def recent_mean(points: list[dict], episodes: int = 100) -> float | None:
    """Mean return over the fewest last log points that hold ``episodes`` episodes; ``None`` before there are as many."""
    count = total = 0.0
    for index in range(len(points) - 1, -1, -1):
        here = episodes_of(points[index], points[index - 1] if index else None)
        if here > 0:
            count += here
            total += here * points[index]["rollout/ep_rew_mean"][0]
        if count >= episodes:
            return total / count
    return None


def watch(command: list[str], folder: Path, threshold: float) -> dict[str, object]:
    """Start ``command``, follow its metrics, let it finish, and tell when the threshold was reached."""
    began = time.monotonic()
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    points: list[dict] = []
    offset, reached, path = 0, None, None
    while process.poll() is None:
        time.sleep(LOOK_EVERY_S)
        path = path or next(folder.glob("**/metrics.jsonl"), None)
        if path is None or reached is not None:
            continue
        lines, offset = new_lines(path, offset)
        for line in lines:
            points.append(json.loads(line))
            mean = recent_mean(points)
            if mean is not None and mean >= threshold and reached is None:
                reached = {"steps": points[-1]["steps"], "cpu_s": process_cpu_s(process.pid), "wall_s": time.monotonic() - began}
    if process.returncode != 0:
        raise RuntimeError(f"expected `{' '.join(command)}` to succeed; it exited with {process.returncode}")
    curve = [(point["steps"], recent_mean(points[: index + 1])) for index, point in enumerate(points)]
    last = points[-1]["steps"] if points else 0
    found = reached or {"steps": last, "cpu_s": None, "wall_s": None}
    return {**found, "reached": reached is not None, "curve": curve[:: max(len(curve) // 50, 1)], "run_wall_s": time.monotonic() - began}


def main() -> None:
    """Run the command on ``--core`` with its output in a folder that is thrown away."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--core", required=True)
    parser.add_argument("--seed", default="0")
    parser.add_argument("--threshold", type=float, default=475.0)
    options = parser.parse_args()
    thorndike = str(Path(sys.executable).parent / "thorndike")
    with tempfile.TemporaryDirectory() as folder:
        train = [thorndike, "train", "ppo", "CartPole-v1", "--seed", options.seed, "--output", folder]
        # taskset becomes the command it starts, so its pid is the contestant's
        found = watch(["taskset", "-c", options.core, *train], Path(folder), options.threshold)
    usage = os.times()
    print(json.dumps({**found, "total_cpu_s": usage.children_user + usage.children_system}))


if __name__ == "__main__":
    main()
