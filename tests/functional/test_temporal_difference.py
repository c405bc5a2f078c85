import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.temporal_difference import (
    double_q_target,
    expected_sarsa_target,
    q_learning_target,
    sarsa_target,
    select,
)

GAMMA = 0.9


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(3)
    return {
        "reward": rng.normal(size=6).astype(np.float32),
        "terminated": np.array([False, True, False, False, True, False]),
        "next_q": rng.normal(size=(6, 4)).astype(np.float32),
        "other_q": rng.normal(size=(6, 4)).astype(np.float32),
        "next_action": rng.integers(0, 4, 6).astype(np.int32),
        "epsilon": rng.random(6).astype(np.float32),
    }


def slow_targets(batch, value_of_successor):
    targets = []
    for i in range(len(batch["reward"])):
        future = 0.0 if batch["terminated"][i] else value_of_successor(i)
        targets.append(batch["reward"][i] + GAMMA * future)
    return np.array(targets)


def assert_equal_with_and_without_jit(function, arguments, expected):
    arguments = [jnp.asarray(argument) for argument in arguments]
    np.testing.assert_allclose(function(*arguments, GAMMA), expected, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda *given: function(*given, GAMMA))(*arguments), expected, rtol=1e-6, atol=1e-6)


def test_q_learning_target_equals_the_loop(batch):
    expected = slow_targets(batch, lambda i: max(batch["next_q"][i]))
    assert_equal_with_and_without_jit(q_learning_target, [batch["reward"], batch["terminated"], batch["next_q"]], expected)


def test_sarsa_target_equals_the_loop(batch):
    expected = slow_targets(batch, lambda i: batch["next_q"][i][batch["next_action"][i]])
    arguments = [batch["reward"], batch["terminated"], batch["next_q"], batch["next_action"]]
    assert_equal_with_and_without_jit(sarsa_target, arguments, expected)


def test_expected_sarsa_target_equals_the_sum_over_the_policy(batch):
    def expectation(i):
        row, epsilon = batch["next_q"][i], batch["epsilon"][i]
        chances = [epsilon / 4 + (1 - epsilon) * (action == int(np.argmax(row))) for action in range(4)]
        return sum(chance * value for chance, value in zip(chances, row, strict=True))

    arguments = [batch["reward"], batch["terminated"], batch["next_q"], batch["epsilon"]]
    assert_equal_with_and_without_jit(expected_sarsa_target, arguments, slow_targets(batch, expectation))


def test_double_q_target_chooses_with_one_table_and_evaluates_with_the_other(batch):
    expected = slow_targets(batch, lambda i: batch["other_q"][i][int(np.argmax(batch["next_q"][i]))])
    arguments = [batch["reward"], batch["terminated"], batch["next_q"], batch["other_q"]]
    assert_equal_with_and_without_jit(double_q_target, arguments, expected)


def test_an_infinite_value_after_a_termination_does_not_leak():
    target = q_learning_target(jnp.array([1.0]), jnp.array([True]), jnp.array([[jnp.inf, jnp.nan]]), GAMMA)
    np.testing.assert_array_equal(target, [1.0])


def test_select_keeps_whole_numbers_whole():
    counts = select(jnp.array([[3, 16_777_217]], jnp.int32), jnp.array([1], jnp.int32))
    assert counts.dtype == jnp.int32
    np.testing.assert_array_equal(counts, [16_777_217])
