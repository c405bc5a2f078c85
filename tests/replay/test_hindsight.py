"""Hindsight against a slow loop over everything that was stored: which goals are drawn, and what they are worth."""

import re
from collections import Counter
from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.algorithms import dqn
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError
from thorndike.replay.hindsight import Hindsight, add_hindsight, goal_of, init_hindsight, replay_for, sample_hindsight, with_goals
from thorndike.replay.replay import Ring
from thorndike.replay.uniform import Transitions, row_shapes
from thorndike.training import runner as runner_module
from thorndike.training.sources import compiled_source
from thorndike.types import EnvSpec, Goal, Rollout, Step

STEPS, NUM_ENVS, GAMMA, DRAWS = 12, 3, 0.9, 6_000
ROW = spaces.Box(-np.inf, np.inf, (1,))
SPACE = spaces.Dict({"observation": ROW, "achieved_goal": ROW, "desired_goal": ROW})
GOAL = Goal(lambda a, d: -(a[..., 0] != d[..., 0]).astype(jnp.float32), lambda a, d: a[..., 0] == d[..., 0])
SPEC = EnvSpec("goals", SPACE, spaces.Discrete(2), NUM_ENVS, goal=GOAL)
NEVER = -1.0
"""A goal that nobody achieves."""


def history(total: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Step ``t`` of environment ``b`` begins in state ``1000 b + t`` and achieves ``1000 b + t + 1``; episodes end at random."""
    rng = np.random.default_rng(seed)
    ends = rng.random((total, NUM_ENVS)) < 0.25
    dead = np.zeros((total, NUM_ENVS), bool)
    # The row after some ends is the dead one of a next-step reset.
    dead[1:] = ends[:-1] & (rng.random((total - 1, NUM_ENVS)) < 0.5)
    ends &= ~dead
    return {"terminated": ends & (rng.random(ends.shape) < 0.5), "ends": ends, "valid": ~dead}


def rollout(past: dict[str, np.ndarray], first: int, length: int) -> Rollout:
    rows = slice(first, first + length)
    state = (np.arange(first, first + length)[:, None] + 1000 * np.arange(NUM_ENVS)).astype(np.float32)[..., None]
    terminated, ends, valid = (jnp.asarray(past[name][rows]) for name in ("terminated", "ends", "valid"))

    def seen(x: np.ndarray) -> dict[str, jax.Array]:
        return {"observation": jnp.asarray(x), "achieved_goal": jnp.asarray(x), "desired_goal": jnp.full(x.shape, NEVER)}

    zeros = jnp.zeros(state.shape[:2])
    step = Step(seen(state + 1), seen(state + 1), zeros - 1, zeros, terminated, ends & ~terminated, valid)
    return Rollout(seen(state), jnp.zeros(state.shape[:2], jnp.int32), {}, step, ())


def episodes(past: dict[str, np.ndarray], total: int) -> dict[tuple[int, int], tuple[int, int]]:
    """(step, environment) -> first and last step of its episode, by walking through all of it."""
    found = {}
    for b in range(NUM_ENVS):
        first = 0
        for t in range(total):
            if past["ends"][t, b] or not past["valid"][t, b] or t == total - 1:
                found |= {(s, b): (first, t) for s in range(first, t + 1)}
                first = t + 1
    return found


def filled(past: dict[str, np.ndarray], total: int, at_once: int):
    replay, write = init_hindsight(row_shapes(SPEC), STEPS, NUM_ENVS), jax.jit(add_hindsight)
    for first in range(0, total, at_once):
        replay = write(replay, rollout(past, first, at_once))
    return replay


def draws(replay, strategy: str, k: float = 4.0) -> Transitions:
    take = jax.jit(partial(sample_hindsight, batch_size=DRAWS, num_envs=NUM_ENVS, gamma=GAMMA, hindsight=Hindsight(strategy, k), goal=GOAL))
    return jax.tree.map(np.asarray, take(replay, jax.random.key(1)))


@pytest.mark.parametrize("strategy", ["future", "final", "episode"])
@pytest.mark.parametrize(("total", "at_once"), [(8, 1), (36, 4), (31, 1)])
def test_goals_are_achievements_of_the_same_episode_and_rewards_and_ends_are_theirs(strategy, total, at_once):
    past = history(total)
    known, batch = episodes(past, total), draws(filled(past, total, at_once), strategy)
    goals_of: dict[tuple[int, int], Counter] = {}
    for i in range(DRAWS):
        state = int(batch.obs["observation"][i, 0])
        b, t = divmod(state, 1000)
        goal, own = float(batch.obs["desired_goal"][i, 0]), (t, b)
        assert batch.next_obs["desired_goal"][i, 0] == goal
        assert t >= total - STEPS
        assert batch.weight[i] == past["valid"][t, b]
        if goal == NEVER:
            assert batch.reward[i] == -1.0
            assert batch.discount[i] == pytest.approx(0.0 if past["terminated"][t, b] else GAMMA)
            continue
        first, last = known[own]
        assert first >= total - STEPS, "an episode whose beginning is overwritten keeps its goal"
        reached = goal == state + 1
        assert batch.reward[i] == (0.0 if reached else -1.0)
        assert batch.discount[i] == pytest.approx(0.0 if reached or past["terminated"][t, b] else GAMMA)
        goals_of.setdefault(own, Counter())[int(goal) - 1000 * b - 1] += 1
    whole = {own for own, (first, _) in known.items() if first >= total - STEPS and own[0] >= total - STEPS}
    assert set(goals_of) == whole
    for (t, b), counted in goals_of.items():
        first, last = known[(t, b)]
        expected = {"final": {last}, "future": set(range(t, last + 1)), "episode": set(range(first, last + 1))}[strategy]
        assert set(counted) == expected, "every one of them, and no other"
        assert max(counted.values()) < 4 * min(counted.values()), "about equally often"


def test_of_k_plus_one_transitions_k_are_relabelled():
    past = history(8)
    replay = filled(past, 8, 1)
    for k in (1.0, 4.0):
        kept = np.mean(draws(replay, "future", k).obs["desired_goal"] == NEVER)
        assert kept == pytest.approx(1 / (k + 1), abs=0.01)


def test_an_end_for_another_reason_stays_and_one_by_the_old_goal_does_not():
    """Three transitions that achieved 5: ended by goal 5; ended by a fall while the goal was 7; not ended."""
    seen = {"observation": jnp.zeros((3, 1)), "achieved_goal": jnp.full((3, 1), 5.0), "desired_goal": jnp.array([[5.0], [7.0], [7.0]])}
    batch = Transitions(seen, jnp.zeros(3), jnp.array([0.0, -1.0, -1.0]), seen, jnp.array([0.0, 0.0, GAMMA]), jnp.ones(3))
    ended, all_of_them = jnp.array([True, True, False]), jnp.ones(3, bool)
    other = with_goals(batch, jnp.full((3, 1), 9.0), all_of_them, ended, GAMMA, GOAL)
    np.testing.assert_allclose(other.discount, [GAMMA, 0.0, GAMMA])
    np.testing.assert_array_equal(other.reward, [-1.0, -1.0, -1.0])
    same = with_goals(batch, jnp.full((3, 1), 5.0), all_of_them, ended, GAMMA, GOAL)
    np.testing.assert_allclose(same.discount, [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(same.reward, [0.0, 0.0, 0.0])


def test_what_has_no_goals_is_refused_in_one_line():
    ring, plain = Ring(row_shapes(SPEC), STEPS, NUM_ENVS), SPEC._replace(observation_space=ROW)
    for act, said in (
        (
            lambda: replay_for(ring, 4, GAMMA, Hindsight("future", 4), SPEC._replace(observation_space=ROW)),
            "needs observations that are a Dict",
        ),
        (lambda: goal_of(SPEC._replace(goal=None)), "hindsight recomputes rewards inside the compiled program"),
    ):
        with pytest.raises(UserError, match=said) as error:
            act()
        assert "\n" not in str(error.value)
    assert replay_for(ring, 4, GAMMA, Hindsight("none", 4), plain)


def test_no_step_copies_the_ring_or_what_is_beside_it(monkeypatch):
    size, programs, compile_segment = 12_347, [], runner_module.compile_segment
    monkeypatch.setattr(runner_module, "compile_segment", lambda lowered: programs.append(compile_segment(lowered)) or programs[-1])
    environment = vectorize(factory("BitFlip-v0")(bits=3), 1)
    config = dqn.Config(
        goal_selection_strategy="future", buffer_size=size, learning_starts=10, batch_size=8, train_freq=1, net_arch=(8,), total_steps=1000
    )
    algorithm = dqn.dqn(config, environment.spec)
    bound = runner_module.runner(algorithm, compiled_source(environment, algorithm, wrappers.chain()), 0, range(1))
    bound.advance(bound.init(), 0, algorithm.needs.warmup_iterations + 2)
    assert len(programs) == 2
    for program in programs:
        assert f"[{size}]" in program.as_text(), "the ring is in the program by this size"
        loops = program.as_text().partition("ENTRY")[0]
        assert not re.findall(rf"= \w+\[{size}[,\]]\S* copy\(", loops)
