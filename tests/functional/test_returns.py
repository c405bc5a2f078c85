"""Returns and advantages against loops, with terminations and time limits told apart."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.functional.returns import discounted_returns, generalized_advantage, lambda_return, n_step_return

GAMMA, LAMBDA = 0.93, 0.8
COMPILED = pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])


def maybe_jit(function, compiled: bool):
    return jax.jit(function) if compiled else function


def random_rows(length: int, batch: int, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random((2, length, batch)) < 0.15
    reward, value, next_value = rng.normal(size=(3, length, batch)).astype(np.float32)
    return {"reward": reward, "value": value, "next_value": next_value, "terminated": terminated, "done": terminated | truncated}


def loop_advantage(reward, value, next_value, terminated, done, gamma, lambda_):
    """The sum of eq. 16 term by term, from every step to the end of its episode."""
    advantage = np.zeros(reward.shape)
    for b in range(reward.shape[1]):
        for t in range(reward.shape[0]):
            weight = 1.0
            for k in range(t, reward.shape[0]):
                future = 0.0 if terminated[k, b] else next_value[k, b]
                advantage[t, b] += weight * (reward[k, b] + gamma * future - value[k, b])
                if done[k, b]:
                    break
                weight *= gamma * lambda_
    return advantage


@COMPILED
@pytest.mark.parametrize(("length", "batch"), [(1, 1), (13, 4), (64, 1)])
def test_generalised_advantages_are_the_sum_of_discounted_errors(length, batch, compiled):
    rows = random_rows(length, batch)
    function = maybe_jit(partial(generalized_advantage, gamma=GAMMA, gae_lambda=LAMBDA), compiled)
    found = function(**jax.tree.map(jnp.asarray, rows))
    expected = loop_advantage(*rows.values(), GAMMA, LAMBDA)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert found.dtype == np.float32


@COMPILED
def test_where_two_players_take_turns_advantages_are_those_of_one_score_that_one_of_them_drives_up_and_the_other_down(compiled):
    rows = random_rows(40, 3, seed=1)
    # Nobody moves strictly in turn: a throw of the dice is several moves.
    sides = np.where(np.random.default_rng(2).random((41, 3)) < 0.5, 1.0, -1.0).astype(np.float32)
    side, following = sides[:-1], sides[1:]
    function = maybe_jit(partial(generalized_advantage, gamma=GAMMA, gae_lambda=LAMBDA), compiled)
    found = function(**jax.tree.map(jnp.asarray, rows), turn=jnp.asarray(side * following))
    reward, value, next_value = side * rows["reward"], side * rows["value"], following * rows["next_value"]
    expected = side * loop_advantage(reward, value, next_value, rows["terminated"], rows["done"], GAMMA, LAMBDA)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def three_steps(terminated: bool, truncated: bool) -> np.ndarray:
    """Advantages of three steps of reward 1, whose second one may end the episode; V is 10 everywhere, 100 at the true successor."""
    column = jnp.array([[False], [True], [False]])
    return np.asarray(
        generalized_advantage(
            reward=jnp.ones((3, 1)),
            value=jnp.full((3, 1), 10.0),
            next_value=jnp.array([[10.0], [100.0], [10.0]]),
            terminated=column & terminated,
            done=column & (terminated | truncated),
            gamma=0.5,
            gae_lambda=0.5,
        )
    )[:, 0]


def test_a_termination_has_no_future_and_stops_the_sum():
    # Errors: 1 + 5 - 10 = -4, 1 - 10 = -9, -4; weight 0.25, none across the end.
    np.testing.assert_allclose(three_steps(True, False), [-4 - 0.25 * 9, -9, -4])


def test_a_time_limit_has_the_true_successors_future_and_stops_the_sum():
    np.testing.assert_allclose(three_steps(False, True), [-4 + 0.25 * 41, 41, -4])


def test_a_death_in_the_step_of_the_time_limit_is_a_death():
    np.testing.assert_allclose(three_steps(True, True), three_steps(True, False))


def test_without_an_end_the_sum_goes_on():
    np.testing.assert_allclose(three_steps(False, False), [-4 + 0.25 * (41 - 0.25 * 4), 41 - 0.25 * 4, -4])


@COMPILED
@pytest.mark.parametrize(("length", "batch"), [(1, 1), (13, 4), (40, 2)])
def test_discounted_returns_are_the_sum_to_the_end_of_the_episode(length, batch, compiled):
    rows = random_rows(length, batch, seed=1)
    bootstrap = np.where(rows["terminated"], 0, rows["next_value"]).astype(np.float32)
    expected = np.zeros((length, batch))
    for b in range(batch):
        for t in range(length):
            for power, k in enumerate(range(t, length)):
                expected[t, b] += GAMMA**power * rows["reward"][k, b]
                if rows["done"][k, b] or k == length - 1:
                    expected[t, b] += GAMMA ** (power + 1) * bootstrap[k, b]
                    break
    function = maybe_jit(partial(discounted_returns, gamma=GAMMA), compiled)
    found = function(*map(jnp.asarray, (rows["reward"], rows["done"], bootstrap)))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_the_return_of_a_terminal_step_is_its_reward():
    reward, done = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([[False], [True], [False]])
    bootstrap = jnp.array([[7.0], [0.0], [8.0]])
    np.testing.assert_allclose(discounted_returns(reward, done, bootstrap, 0.5)[:, 0], [1 + 0.5 * 2, 2, 4 + 0.5 * 8])


@COMPILED
@pytest.mark.parametrize("n", [1, 2, 5])
def test_n_step_returns_equal_a_loop(n, compiled):
    rows = random_rows(n, 200, seed=2)
    total, discount, last = np.zeros(200), np.zeros(200), np.zeros(200, int)
    for b in range(200):
        for k in range(n):
            total[b] += GAMMA**k * rows["reward"][k, b]
            last[b], discount[b] = k, 0.0 if rows["terminated"][k, b] else GAMMA ** (k + 1)
            if rows["done"][k, b]:
                break
    function = maybe_jit(partial(n_step_return, gamma=GAMMA), compiled)
    found = function(*(jnp.asarray(rows[name]) for name in ("reward", "terminated", "done")))
    for ours, expected in zip(found, (total, discount, last), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=1e-6)


def test_n_step_returns_bootstrap_from_a_time_limit_but_not_from_a_death_nor_beyond_either():
    # Columns: no end; death at the second step; limit at the second; limit at the second and a death at the third, of the next episode.
    no, yes = False, True
    terminated = jnp.array([[no, no, no, no], [no, yes, no, no], [no, no, no, yes]])
    truncated = jnp.array([[no, no, no, no], [no, no, yes, yes], [no, no, no, no]])
    reward = jnp.array([[1.0] * 4, [2.0] * 4, [4.0] * 4])
    total, discount, last = n_step_return(reward, terminated, terminated | truncated, 0.5)
    np.testing.assert_allclose(total, [3, 2, 2, 2])
    np.testing.assert_allclose(discount, [0.125, 0, 0.25, 0.25])
    np.testing.assert_array_equal(last, [2, 1, 1, 1])


@COMPILED
def test_lambda_returns_are_those_of_a_loop(compiled):
    rng = np.random.default_rng(2)
    length, envs, gamma, decay = 12, 3, 0.9, 0.7
    reward, value = rng.normal(size=(2, length, envs)).astype(np.float32)
    terminated, truncated = rng.random((2, length, envs)) < 0.2
    done = terminated | truncated
    expected = np.zeros((length, envs))
    for b in range(envs):
        for t in reversed(range(length)):
            last = done[t, b] or t == length - 1
            ahead = value[t, b] if last else (1 - decay) * value[t, b] + decay * expected[t + 1, b]
            expected[t, b] = reward[t, b] + gamma * (0.0 if terminated[t, b] else ahead)
    found = maybe_jit(lambda_return, compiled)(*map(jnp.asarray, (reward, value, terminated, done)), gamma, decay)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
