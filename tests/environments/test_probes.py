"""The probes' right values satisfy the Bellman equation on the probes as they really run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.environments.native import NATIVE, factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.probes import PROBES, Probe

BATCH, STEPS = 16, 40
IDS = [probe.id for probe in PROBES]


def transitions(probe: Probe, actions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Index of the observation, reward, terminated, truncated, index of the true successor, of the next observation: ``[T, B]``."""
    environment = vectorize(factory(probe.id)(), BATCH)

    key_init, key_draw = jax.random.split(jax.random.key(0))
    state, first = environment.init(key_init)
    noise = environment.draw(key_draw, STEPS)
    rows = []
    # Step by step: the operations are compiled once for all probes, a scan would be compiled for each.
    for t in range(STEPS):
        state, step = environment.step(state, actions[t], jax.tree.map(lambda leaf, t=t: leaf[t], noise))
        rows.append(step)
    steps = jax.tree.map(lambda *leaves: np.stack(leaves), *rows)
    before = np.concatenate([np.asarray(first)[None], steps.obs[:-1]])
    return (
        index(probe, before),
        steps.reward,
        steps.terminated,
        steps.truncated,
        index(probe, steps.next_obs),
        index(probe, steps.obs),
    )


def index(probe: Probe, obs: np.ndarray) -> np.ndarray:
    """Which of the probe's observations each is, ``[T, B]``; -1 for one that is only seen when an episode has ended."""
    match = obs == np.array(probe.observations, np.float32)
    return np.where(match.any(axis=-1), match.argmax(axis=-1), -1)


def shaped(probe: Probe, actions: np.ndarray) -> np.ndarray:
    """Numbers ``[T, B]`` as actions of the probe's space."""
    discrete = probe.action_values is not None
    return actions.astype(np.int32) if discrete else actions.astype(np.float32)[..., None]


def targets(probe: Probe, rows: tuple[np.ndarray, ...]) -> np.ndarray:
    """Reward and the discounted right value of the true successor: a time limit is no end, a termination is."""
    _, reward, terminated, _, after, _ = rows
    return reward + probe.gamma * np.where(terminated, 0.0, np.array(probe.values)[after])


@pytest.mark.parametrize("probe", PROBES, ids=IDS)
def test_right_values_satisfy_the_bellman_equation(probe: Probe) -> None:
    rng = np.random.default_rng(0)
    low, high = (0, 2) if probe.action_values else (-1, 1)
    numbers = rng.integers(low, high, (STEPS, BATCH)) if probe.action_values else rng.uniform(low, high, (STEPS, BATCH))
    rows = transitions(probe, shaped(probe, numbers))
    seen = rows[0]
    assert set(np.unique(seen)) == set(range(len(probe.observations))), "every listed observation and no other is decided on"
    backed_up, right = targets(probe, rows), np.array(probe.values)[seen]
    tolerance = 1e-5 * probe.scale
    assert (backed_up <= right + tolerance).all(), "no action is worth more than the best"
    if probe.action_values:
        np.testing.assert_allclose(backed_up, np.array(probe.action_values)[seen, numbers], rtol=1e-6, atol=tolerance)
        np.testing.assert_allclose(np.max(probe.action_values, axis=1), probe.values)
    if probe.actions is None:
        np.testing.assert_allclose(backed_up, right, rtol=1e-6, atol=tolerance)


@pytest.mark.parametrize("probe", [probe for probe in PROBES if probe.actions], ids=[probe.id for probe in PROBES if probe.actions])
def test_the_best_actions_earn_the_right_values(probe: Probe) -> None:
    dynamics = factory(probe.id)()
    noise = dynamics.draw_reset(jax.random.key(1), (32,))
    state = jnp.broadcast_to(dynamics.reset(noise), (32,))
    seen = index(probe, np.asarray(dynamics.observe(state)))
    best = shaped(probe, np.array(probe.actions)[seen])
    reward = dynamics.step(state, best, dynamics.draw_step(jax.random.key(2), (32,)))[1]
    np.testing.assert_allclose(reward, np.array(probe.values)[seen], rtol=1e-6)


def fixed_point(rows: tuple[np.ndarray, ...], gamma: float, dead_at_limit: bool, after_reset: bool) -> np.ndarray:
    """Values that a learner with this mistake ends with."""
    seen, reward, terminated, truncated, after, following = rows
    ended = terminated | truncated if dead_at_limit else terminated
    successor = following if after_reset else after
    values = np.zeros(2)
    for _ in range(500):
        target = reward + gamma * np.where(ended, 0, values[successor])
        values = np.array([target[seen == i].mean() for i in range(2)])
    return values


def test_the_time_limit_probe_tells_the_known_mistakes_apart() -> None:
    probe = next(probe for probe in PROBES if probe.id == "probe/TimeLimit-v0")
    rows = transitions(probe, np.zeros((STEPS, BATCH), np.int32))
    assert (np.flatnonzero(rows[3][:, 0]) == [9, 19, 29, 39]).all(), "truncated at every tenth step"
    assert not rows[2].any()
    assert fixed_point(rows, 0.9, dead_at_limit=False, after_reset=False) == pytest.approx([9, 10], abs=1e-4)
    assert fixed_point(rows, 0.9, dead_at_limit=True, after_reset=False)[1] == pytest.approx(5.00, abs=1e-2)
    assert fixed_point(rows, 0.9, dead_at_limit=False, after_reset=True)[1] == pytest.approx(9.09, abs=1e-2)


def test_every_probe_is_registered_with_its_action_space() -> None:
    assert {id for id in NATIVE if id.startswith("probe/")} == {*IDS, "probe/Counting-v0"}
    for probe in PROBES:
        dynamics = factory(probe.id)()
        assert dynamics.id == probe.id
        assert isinstance(dynamics.action_space, spaces.Discrete if probe.action_values else spaces.Box)
        assert all(dynamics.observation_space.contains(np.array([obs], np.float32)) for obs in probe.observations)
