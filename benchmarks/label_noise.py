"""What each way of aggregating labels makes of a simulated crowd: 8 fair raters, 3 who guess, 1 who has it the wrong way round.

`python benchmarks/label_noise.py [--pairs 6600] [--labels 3] [--seeds 5]`: label accuracy against the truth, and reliabilities, a line a
seed. Utilities are drawn from a standard normal distribution; fair raters choose by Bradley-Terry at temperature 0.5, with 5 % lapses.
"""

import argparse

import numpy as np

from thorndike.language.preferences.noise import dawid_skene, majority
from thorndike.language.preferences.raters import crowd, crowd_comparisons


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("pairs", 6_600), ("labels", 3), ("seeds", 5)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    print("seed  single  majority  dawid_skene  fair (worst)  guessing  inverted")
    rows = []
    for seed in range(options.seeds):
        utilities = np.random.default_rng(seed).normal(size=(options.pairs, 2))
        truth = utilities[:, 0] > utilities[:, 1]
        labels = crowd_comparisons(utilities, crowd(), options.labels, seed)
        belief = dawid_skene(labels).belief
        single = labels.value[np.unique(labels.pair, return_index=True)[1]]
        sides = [single, majority(labels).first_is_better, belief.first_is_better]
        trusted = dict(zip(labels.raters, belief.reliability.tolist(), strict=True))
        fair = min(value for name, value in trusted.items() if name.startswith("fair"))
        guessing = np.mean([value for name, value in trusted.items() if name.startswith("guessing")])
        rows.append([*(_accuracy(side, truth) for side in sides), fair, float(guessing), trusted["inverted-1"]])
        print(f"{seed:4}  " + "  ".join(f"{value:.3f}" for value in rows[-1]))
    print("mean  " + "  ".join(f"{value:.3f}" for value in np.mean(rows, axis=0)))


def _accuracy(first_is_better: np.ndarray, truth: np.ndarray) -> float:
    return float(np.where(first_is_better == 0.5, 0.5, (first_is_better > 0.5) == truth).mean())


if __name__ == "__main__":
    main()
