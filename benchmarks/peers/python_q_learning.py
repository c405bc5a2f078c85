"""Tabular Q-learning on FrozenLake-v1 in plain Python over Gymnasium, one seed: the loop of a textbook.

``--table lists`` keeps Q in Python lists, the fastest plain form; ``--table numpy`` in a NumPy array, the form tutorials show.
"""

import argparse
import random

import gymnasium
import numpy
from measurement import cpu_seconds, now, report, window

ALPHA, GAMMA, EPSILON_START, EPSILON_END = 0.1, 0.99, 1.0, 0.1


def learn_lists(env: gymnasium.Env, steps: int, seed: int) -> None:
    """Q-learning with epsilon falling linearly over the first half of ``steps``; Q in lists."""
    q = [[0.0] * 4 for _ in range(16)]
    draw = random.Random(seed)
    state, _ = env.reset(seed=seed)
    for t in range(steps):
        epsilon = max(EPSILON_END, EPSILON_START - 2 * t / steps * (EPSILON_START - EPSILON_END))
        row = q[state]
        action = draw.randrange(4) if draw.random() < epsilon else row.index(max(row))
        successor, reward, terminated, truncated, _ = env.step(action)
        target = reward if terminated else reward + GAMMA * max(q[successor])
        row[action] += ALPHA * (target - row[action])
        state = env.reset()[0] if terminated or truncated else successor


def learn_numpy(env: gymnasium.Env, steps: int, seed: int) -> None:
    """The same with Q in a NumPy array."""
    q = numpy.zeros((16, 4))
    draw = numpy.random.default_rng(seed)
    state, _ = env.reset(seed=seed)
    for t in range(steps):
        epsilon = max(EPSILON_END, EPSILON_START - 2 * t / steps * (EPSILON_START - EPSILON_END))
        action = int(draw.integers(4)) if draw.random() < epsilon else int(numpy.argmax(q[state]))
        successor, reward, terminated, truncated, _ = env.step(action)
        q[state, action] += ALPHA * (reward + GAMMA * (not terminated) * numpy.max(q[successor]) - q[state, action])
        state = env.reset()[0] if terminated or truncated else successor


def main() -> None:
    """Learn 2,000 steps ahead of the window, then ``--steps`` in it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", choices=("lists", "numpy"), default="lists")
    options = parser.parse_args()
    import_cpu_s = cpu_seconds()
    learn = {"lists": learn_lists, "numpy": learn_numpy}[options.table]
    env = gymnasium.make("FrozenLake-v1")
    learn(env, 2_000, options.seed)
    start = now()
    learn(env, options.steps, options.seed)
    end = now(options.steps)
    report(**window(start, end), compile_s=None, import_cpu_s=import_cpu_s)


if __name__ == "__main__":
    main()
