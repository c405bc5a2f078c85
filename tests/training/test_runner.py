"""Iterations and their random numbers, with a learner and a source that only write down what they are given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from thorndike.training import segment
from thorndike.training.runner import run_keys, runner
from thorndike.types import Algorithm, EnvSpec, EpisodeStats, Needs, Source

PAGE, WARMUP = 4, 3
NEEDS = Needs(rollout_length=1, on_policy=True, warmup_iterations=WARMUP)


def noting_algorithm() -> Algorithm:
    """Its state counts updates; its metrics are the random numbers of the iteration, from the source and for the update."""

    def update(state, rollout, key):
        return state + 1, {"drawn": rollout, "own": jax.random.uniform(key), "updates": state}

    def observe(state, rollout, key):
        return state, {"drawn": rollout, "own": jax.random.uniform(key)}

    def nothing(*arguments):
        return ()

    return Algorithm(lambda key: jnp.float32(0), lambda state: state, nothing, nothing, nothing, nothing, nothing, update, observe, NEEDS)


def noting_source(compiled: bool) -> Source:
    def collect(state, actor, noise):
        zeros = jnp.zeros_like(noise)
        return state + 1, noise, EpisodeStats(zeros + 1, zeros, zeros, zeros + 1)

    return Source(
        init=lambda keys: jnp.zeros(keys.shape, jnp.float32),
        draw=lambda key, iterations: jax.random.uniform(key, (iterations,)),
        collect=collect,
        statistics=lambda state: (),
        spec=EnvSpec("noted", spaces.Discrete(2), spaces.Discrete(2), 1),
        compiled=compiled,
    )


def noted(compiled: bool, indices: range, segments: list[int], seed: int = 0) -> dict[str, np.ndarray]:
    """Means of each segment ``[segments, S]``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segment, "_ROWS_OF_A_PAGE", PAGE)
        bound = runner(noting_algorithm(), noting_source(compiled), seed, indices)
    carry, first, reports = bound.init(), 0, []
    for count in segments:
        carry, report = bound.advance(carry, first, count)
        assert (np.asarray(report.episodes.episodes) == count).all()
        reports.append(jax.tree.map(np.asarray, report.metrics))
        first += count
    assert (np.asarray(carry.source) == first).all()
    assert (np.asarray(carry.learner) == first - WARMUP).all()
    return {name: np.stack([report[name] for report in reports]) for name in ("drawn", "own")}


def test_no_random_number_is_used_twice():
    found = noted(True, range(3), [1] * 14)
    for numbers in found.values():
        assert numbers.shape == (14, 3)
        assert len(np.unique(numbers)) == numbers.size, "over iterations, pages of them, and seeds"
    assert not np.intersect1d(found["drawn"], found["own"]).size
    other = noted(True, range(3), [1] * 14, seed=1)
    assert not np.intersect1d(found["drawn"], other["drawn"]).size, "nor by another run"


def test_a_host_source_gets_the_numbers_that_a_compiled_one_gets():
    compiled, host = (noted(kind, range(2), [1] * 10) for kind in (True, False))
    for name in compiled:
        np.testing.assert_array_equal(compiled[name], host[name])


@pytest.mark.parametrize("compiled", [True, False])
def test_segments_may_be_cut_anywhere_and_report_the_mean_of_their_iterations(compiled):
    """Across the end of the warm-up (whose metrics are its own) and of pages of random numbers."""
    single, cut = noted(compiled, range(2), [1] * 13), noted(compiled, range(2), [3, 1, 6, 3])
    for name in single:
        for part, (start, end) in enumerate([(0, 3), (3, 4), (4, 10), (10, 13)]):
            np.testing.assert_allclose(cut[name][part], single[name][start:end].mean(axis=0), rtol=1e-6)


def test_a_segment_over_the_end_of_the_warm_up_reports_what_was_learnt():
    single, cut = noted(True, range(2), [1] * 7), noted(True, range(2), [7])
    np.testing.assert_allclose(cut["drawn"][0], single["drawn"][WARMUP:].mean(axis=0), rtol=1e-6)


def test_an_agent_has_its_numbers_whatever_the_others():
    among, alone = noted(True, range(4), [1] * 6), noted(True, range(2, 3), [1] * 6)
    np.testing.assert_array_equal(among["drawn"][:, 2:3], alone["drawn"])


def test_agents_and_runs_have_keys_of_their_own():
    keys = [
        tuple(words)
        for seed in range(20)
        for words in np.asarray(jax.random.key_data(run_keys(seed, jnp.arange(20, dtype=jnp.uint32)))).tolist()
    ]
    assert len(set(keys)) == 400
