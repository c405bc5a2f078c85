"""Frames kept once: what is drawn equals what a memory that keeps whole stacks draws, wherever episodes begin and end."""

from functools import partial

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.replay.frames import Stacks, once_each, stacks_of
from thorndike.replay.replay import Ring, prioritized_replay, sequence_replay, uniform_replay
from thorndike.replay.uniform import Transitions, row_shapes
from thorndike.types import EnvSpec, Rollout, Step

STEPS, NUM_ENVS, FRAMES, CHANNELS, AT_ONCE = 48, 3, 4, 2, 4
SPEC = EnvSpec("frames", spaces.Box(0, 255, (2, 3, FRAMES * CHANNELS), np.uint8), spaces.Discrete(5), NUM_ENVS, frames=FRAMES)
RING = Ring(row_shapes(SPEC), STEPS, NUM_ENVS)
BUILDERS = {
    "uniform": partial(uniform_replay, batch_size=256, n_step=1, gamma=0.9),
    "three steps": partial(uniform_replay, batch_size=256, n_step=3, gamma=0.9),
    "prioritized": partial(prioritized_replay, batch_size=256, n_step=3, gamma=0.9, alpha=0.6),
    "sequences": partial(sequence_replay, count=64, length=5),
}
FILLINGS = ("black", "repeated", "other frames")


class Stream:
    """Frames of random pixels as an engine shows them; ``dead_rows`` after each end, as next-step autoreset makes them."""

    def __init__(self, seed: int, filling: str, dead_rows: bool, mean_length: float) -> None:
        self.rng, self.filling, self.dead_rows, self.mean_length = np.random.default_rng(seed), filling, dead_rows, mean_length
        self.obs = np.stack([self.start() for _ in range(NUM_ENVS)])
        self.ended = np.zeros(NUM_ENVS, bool)

    def frame(self) -> np.ndarray:
        return self.rng.integers(1, 256, (2, 3, CHANNELS), dtype=np.uint8)

    def start(self) -> np.ndarray:
        first = self.frame()
        older = {"black": np.zeros_like(first), "repeated": first}
        frames = [older[self.filling] if self.filling in older else self.frame() for _ in range(FRAMES - 1)]
        return np.concatenate([*frames, first], axis=-1)

    def step(self) -> Rollout:
        obs, valid = self.obs, ~self.ended if self.dead_rows else np.ones(NUM_ENVS, bool)
        fresh = np.stack([self.start() for _ in range(NUM_ENVS)])
        onward = np.stack([np.concatenate([one[..., CHANNELS:], self.frame()], axis=-1) for one in obs])
        next_obs = np.where(valid[:, None, None, None], onward, fresh)
        ends = valid & (self.rng.random(NUM_ENVS) < 1 / self.mean_length)
        terminated, truncated = ends & (self.rng.random(NUM_ENVS) < 0.5), np.zeros(NUM_ENVS, bool)
        truncated = ends & ~terminated
        self.ended = ends
        self.obs = next_obs if self.dead_rows else np.where(ends[:, None, None, None], fresh, next_obs)
        reward = self.rng.random(NUM_ENVS, np.float32)
        step = Step(self.obs, next_obs, reward, np.zeros_like(reward), terminated, truncated, valid)
        return Rollout(obs, self.rng.integers(0, 5, NUM_ENVS).astype(np.int32), {}, step, ())

    def rollout(self) -> Rollout:
        rows = [self.step() for _ in range(AT_ONCE)]
        return jax.tree.map(lambda *row: jnp.asarray(np.stack(row)), *rows)


@pytest.fixture(scope="module", params=BUILDERS)
def memories(request):
    """The one that keeps stacks and the one that keeps frames, compiled."""
    build = BUILDERS[request.param]
    plain, frames = build(RING), once_each(Stacks(2, 3, CHANNELS, FRAMES), RING, build)
    return [memory._replace(add=jax.jit(memory.add), sample=jax.jit(memory.sample)) for memory in (plain, frames)]


@pytest.mark.parametrize("filling", FILLINGS)
@pytest.mark.parametrize("dead_rows", [False, True])
def test_what_is_drawn_equals_what_a_memory_of_whole_stacks_draws(memories, filling, dead_rows):
    stream = Stream(len(filling), filling, dead_rows, mean_length=25.0)
    held = [memory.init() for memory in memories]
    for number in range(2 * STEPS // AT_ONCE + 3):
        rollout = stream.rollout()
        held = [memory.add(state, rollout) for memory, state in zip(memories, held, strict=True)]
        if number % 5 == 2:
            draws = [memory.sample(state, jax.random.key(number), 0.5) for memory, state in zip(memories, held, strict=True)]
            # With 25 steps an episode the oldest few may have lost their frames; the spare ones make up for most.
            assert compare(*draws) >= 0.9


def compare(plain, frames) -> float:
    """Raises where the two differ; which share of the rows counts in both."""
    np.testing.assert_array_equal(plain.rows, frames.rows)
    np.testing.assert_array_equal(plain.importance, frames.importance)
    used = parts(plain.batch)[0] & parts(frames.batch)[0]
    for ours, theirs in zip(parts(frames.batch)[1:], parts(plain.batch)[1:], strict=True):
        np.testing.assert_array_equal(ours[used], theirs[used])
    return used.sum() / parts(plain.batch)[0].sum()


def parts(batch) -> list[np.ndarray]:
    """Which rows count, then everything in them."""
    if isinstance(batch, Transitions):
        return [np.asarray(x) for x in (batch.weight > 0, batch.obs, batch.next_obs, batch.action, batch.reward, batch.discount)]
    step = batch.step
    return [np.asarray(x) for x in (step.valid, batch.obs, step.next_obs, batch.action, step.reward, step.terminated, step.truncated)]


@pytest.mark.parametrize("filling", FILLINGS)
def test_frames_that_were_written_over_are_never_shown(filling):
    """Episodes of two steps need three times the frames that there is room for."""
    memories = [BUILDERS["uniform"](RING), once_each(Stacks(2, 3, CHANNELS, FRAMES), RING, BUILDERS["uniform"])]
    stream, held, add = (
        Stream(1, filling, False, mean_length=2.0),
        [memory.init() for memory in memories],
        [jax.jit(m.add) for m in memories],
    )
    for _ in range(3 * STEPS // AT_ONCE):
        rollout = stream.rollout()
        held = [write(state, rollout) for write, state in zip(add, held, strict=True)]
    plain, frames = (memory.sample(state, jax.random.key(0), jnp.ones(())).batch for memory, state in zip(memories, held, strict=True))
    used = np.asarray(frames.weight) > 0
    assert 0.1 < used.mean() < 0.9
    np.testing.assert_array_equal(frames.obs[used], plain.obs[used])
    np.testing.assert_array_equal(frames.next_obs[used], plain.next_obs[used])


def test_only_stacks_of_pictures_are_taken_apart():
    assert stacks_of(SPEC) == Stacks(2, 3, CHANNELS, FRAMES)
    assert stacks_of(SPEC._replace(frames=1)) is None
    assert stacks_of(SPEC._replace(frames=3)) is None
    assert stacks_of(SPEC._replace(observation_space=spaces.Box(0, 1, (2, 3, 8)))) is None
    assert stacks_of(SPEC._replace(observation_space=spaces.Discrete(4))) is None


def test_a_million_atari_frames_are_predicted_to_take_less_than_8_gigabytes():
    spec = EnvSpec("pong", spaces.Box(0, 255, (84, 84, 4), np.uint8), spaces.Discrete(6), 4, frames=4)
    memory = once_each(stacks_of(spec), Ring(row_shapes(spec), 250_000, 4), BUILDERS["prioritized"])
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(jax.eval_shape(memory.init)))
    assert 7.1e9 < size < 8e9
