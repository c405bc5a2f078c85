"""Learners from data on a corridor whose right answer is known exactly, from a log that mostly does the wrong thing.

Cells 1 to 5 are shown as one-hot rows. Right of them lies 1, left of them 0.3, and both are ends. The log goes left three times of
four, never takes the third action, and its episodes are cut after two steps: none of them holds the whole way from left to right.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from thorndike.algorithms import bc, cql, iql
from thorndike.training.dataset_source import dataset_source, dataset_spec
from thorndike.training.datasets import Dataset, Origin
from thorndike.training.runner import runner

CELLS, ACTIONS, GAMMA, LIMIT = 5, 3, 0.9, 2
LEFT, RIGHT = 0, 1
SHARES = (0.75, 0.25)
"""How often the log goes left and right."""
SETTINGS = {"batch_size": 64, "net_arch": (32,), "learning_rate": "linear(0.01, 0)"}
SEEDS = 3


def outcome(cell: int, action: int) -> tuple[int, float, bool]:
    """Next cell, reward, end. Cells are counted from 0."""
    after = cell + (1 if action == RIGHT else -1)
    if after in (-1, CELLS):
        return cell, 1.0 if after == CELLS else 0.3, True
    return after, 0.0, False


def corridor_log() -> Dataset:
    """Every cell and action as often as its share says, as the first and as the second step of an episode."""
    rows, lengths = [], []
    for start in range(CELLS):
        for first in (LEFT, LEFT, LEFT, RIGHT):
            for second in (LEFT, LEFT, LEFT, RIGHT):
                cell, length, ended = start, 0, False
                for action in (first, second):
                    if ended:
                        break
                    after, reward, ended = outcome(cell, action)
                    length += 1
                    rows.append((cell, action, reward, after, ended, not ended and length == LIMIT))
                    cell = after
                lengths.append(length)
    cell, action, reward, after, terminated, truncated = (np.array(column) for column in zip(*rows, strict=True))
    shown = np.eye(CELLS, dtype=np.float32)
    origin = Origin("Corridor-v0", {}, LIMIT, spaces.Box(0.0, 1.0, (CELLS,), np.float32), spaces.Discrete(ACTIONS))
    return Dataset(
        path=Path("corridor"),
        origin=origin,
        obs=shown[cell],
        next_obs=shown[after],
        action=action.astype(np.int32),
        reward=reward.astype(np.float32),
        terminated=terminated,
        truncated=truncated,
        probability=None,
        lengths=np.array(lengths, np.int64),
        sha256="0" * 64,
    )


def backed_up(value: np.ndarray) -> np.ndarray:
    """``r + gamma V(s')`` of what the log holds, ``[CELLS, 2]``."""
    found = np.zeros((CELLS, 2))
    for cell in range(CELLS):
        for action in (LEFT, RIGHT):
            after, reward, ended = outcome(cell, action)
            found[cell, action] = reward + (0.0 if ended else GAMMA * value[after])
    return found


def implicit_values(expectile: float) -> np.ndarray:
    """The fixed point of IQL: of two numbers the expectile is a mean, in which the larger one weighs more."""
    value = np.zeros(CELLS)
    for _ in range(500):
        q = backed_up(value)
        weight = np.where(q == q.max(axis=1, keepdims=True), expectile, 1.0 - expectile) * np.array(SHARES)
        value = (weight * q).sum(axis=1) / weight.sum(axis=1)
    return value


def conservative_values(alpha: float) -> np.ndarray:
    """The fixed point of CQL where the action never taken has fallen out of the log-sum: ``Q = target - alpha (pi / share - 1)``."""
    q = np.zeros((CELLS, 2))
    for _ in range(5_000):
        likely = np.exp(q) / np.exp(q).sum(axis=1, keepdims=True)
        q = 0.9 * q + 0.1 * (backed_up(q.max(axis=1)) - alpha * (likely / np.array(SHARES) - 1.0))
    return q.max(axis=1)


def learnt(module, updates: int, **settings) -> tuple[np.ndarray, np.ndarray]:
    """Best actions and values of every cell, ``[SEEDS, CELLS]``."""
    data, name = corridor_log(), module.__name__.rpartition(".")[2]
    algorithm = getattr(module, name)(module.Config(total_steps=updates, **SETTINGS | settings), dataset_spec(data))
    bound = runner(algorithm, dataset_source(data, algorithm), 0, range(SEEDS))
    carry, _ = bound.advance(bound.init(), 0, updates // algorithm.needs.rollout_length)
    obs = jnp.eye(CELLS)

    def told(learner):
        actor = algorithm.actor(learner)
        noise = algorithm.draw(jax.random.key(0), 1)[0]
        return algorithm.greedy(actor, algorithm.memory(CELLS), obs, noise)[1], algorithm.value(actor, obs)

    actions, values = jax.vmap(told)(carry.learner)
    return np.asarray(actions), np.asarray(values)


def test_the_log_holds_no_way_through_and_cloning_it_goes_left(quick_compile):
    data = corridor_log()
    assert data.lengths.max() == LIMIT
    assert data.truncated.sum() > 40
    actions, _ = learnt(bc, 400)
    assert (actions == LEFT).all()


def test_implicit_q_learning_finds_its_fixed_point_and_goes_right(quick_compile):
    actions, values = learnt(iql, 3_000, gamma=GAMMA, tau=0.05, expectile=0.95, temperature=0.03)
    np.testing.assert_allclose(values, np.broadcast_to(implicit_values(0.95), values.shape), atol=0.03)
    assert (actions == RIGHT).all()


def test_conservative_q_learning_finds_its_fixed_point_and_goes_right(quick_compile):
    actions, values = learnt(cql, 3_000, gamma=GAMMA, tau=0.05, alpha=0.02)
    np.testing.assert_allclose(values, np.broadcast_to(conservative_values(0.02), values.shape), atol=0.03)
    assert (actions == RIGHT).all()
