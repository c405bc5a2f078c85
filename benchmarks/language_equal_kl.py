"""Best of n, DPO, RLOO and PPO at equal distance from the base, one figure: `python benchmarks/language_equal_kl.py`.

Reads benchmarks/results/language/demo.json, which language_demo.py wrote; draws docs/images/language_equal_kl.png: gold and proxy by the
divergence from the base. A learner's line are the texts that it wrote while it learnt, in bins of a nat, over all seeds; diamonds are the
finished policies on held-out prompts.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thorndike.plotting.style import COLOURS, STYLE, save_figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "language" / "demo.json"
PICTURE = ROOT / "docs" / "images" / "language_equal_kl.png"
NAMES = {"ppo": "PPO", "rloo": "RLOO", "grpo": "GRPO", "dpo": "DPO", "ppo_max_kl": "PPO without a penalty"}
LONGEST = 30.0
Report = Mapping[str, object]


def binned(reports: Sequence[Report], name: str, figure: str) -> tuple[list[float], list[float]]:
    """Means over a nat of divergence, of all seeds' iterations; the way back, where the controller pulls, is left out."""
    points = []
    for report in reports:
        farthest = -1.0
        for point in cast(dict, report.get(name, {"curve": []}))["curve"]:
            if point["kl"] >= farthest:
                farthest = point["kl"]
                points.append((point["kl"], point[figure]))
    bins: dict[int, list[tuple[float, float]]] = {}
    for point in points:
        bins.setdefault(int(point[0]), []).append(point)
    means = [np.mean(bins[number], axis=0) for number in sorted(bins) if number < LONGEST]
    return [float(each[0]) for each in means], [float(each[1]) for each in means]


def draw(axes: Axes, reports: Sequence[Report], figure: str) -> None:
    points = [cast(dict, report["best_of_n"])["points"] for report in reports]
    kl = [each["kl"] for each in points[0]]
    values = np.mean([[each["proxy" if figure == "score" else figure] for each in seed] for seed in points], axis=0)
    axes.plot(kl, values, "o-", color=COLOURS[6], markersize=4, label="best of n, n = 1 to 64")
    for colour, (name, title) in zip(COLOURS, NAMES.items(), strict=False):
        if any(name in report for report in reports):
            axes.plot(*binned(reports, name, figure), "-", color=colour, linewidth=1.5, label=title)
            judged = "proxy" if figure == "score" else "gold"
            ends = [
                (cast(dict, report[name])["kl"], cast(dict, report[name])["judged"][judged]["policy"])
                for report in reports
                if name in report
            ]
            axes.plot(*zip(*ends, strict=True), "D", color=colour, markersize=4)
    axes.set(xlabel="divergence from the base (nats a text)", xlim=(-0.3, LONGEST))


def main() -> None:
    reports = json.loads(RESULTS.read_text())["reports"]
    with mpl.rc_context(cast(dict, STYLE)):
        whole = Figure(figsize=(11, 4.2), layout="constrained")
        for axes, figure, title in zip(
            whole.subplots(1, 2), ("gold", "score"), ("What is wanted (gold)", "What the reward model says (proxy)"), strict=True
        ):
            draw(axes, reports, figure)
            axes.set(title=title)
        whole.axes[0].legend()
        print(save_figure(whole, PICTURE))


if __name__ == "__main__":
    main()
