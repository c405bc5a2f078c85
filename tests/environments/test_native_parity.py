"""Native environments against Gymnasium 1.4.0: from the same states, 10,000 steps each, equal to float32 precision."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.toy_text import blackjack as reference_blackjack
from gymnasium.envs.toy_text.frozen_lake import generate_random_map
from gymnasium.wrappers import TimeLimit

from thorndike.environments.native import factory
from thorndike.environments.native.blackjack import Hand, blackjack, deal, dealer_distribution
from thorndike.environments.native.table import Table, has_table, read_table, table_dynamics
from thorndike.environments.native.vectorize import Dynamics, vectorize
from thorndike.errors import UserError

BATCH = 20
STEPS = 500
"""20 x 500 = 10,000 steps an environment."""


class Trace(NamedTuple):
    """What happened at each step, ``[10000, ...]``, as NumPy arrays."""

    state: np.ndarray
    clock: np.ndarray
    action: np.ndarray
    next_obs: np.ndarray
    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray


def trace(dynamics: Dynamics, limit: int | None, behave: Callable) -> Trace:
    """Runs the native environment; ``behave(state, number)`` chooses actions from uniform numbers in [0, 1)."""
    environment = vectorize(dynamics, BATCH, limit)

    @jax.jit
    def run(key: jax.Array) -> Trace:
        key_init, key_draw, key_act = jax.random.split(key, 3)

        def one(state: tuple, noise: tuple) -> tuple:
            action = behave(state.inner, noise[0])
            after, step = environment.step(state, action, noise[1])
            clock = jnp.zeros(BATCH, jnp.int32) if isinstance(state.clock, tuple) else state.clock
            return after, Trace(state.inner, clock, action, step.next_obs, step.obs, step.reward, step.terminated, step.truncated)

        numbers = jax.random.uniform(key_act, (STEPS, BATCH))
        return jax.lax.scan(one, environment.init(key_init)[0], (numbers, environment.draw(key_draw, STEPS)), length=STEPS)[1]

    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(STEPS * BATCH, *leaf.shape[2:]), run(jax.random.key(7)))


def push_along(state: jax.Array, number: jax.Array, velocity: int) -> jax.Array:
    """Mostly in the direction of motion, which reaches the goals; 0, 1 or 2."""
    return jnp.where(number < 0.9, jnp.where(state[..., velocity] > 0, 2, 0), jnp.floor(number * 30) % 3).astype(jnp.int32)


def force_along(state: jax.Array, number: jax.Array) -> jax.Array:
    """The same as a force, often beyond the limit of 1."""
    return (jnp.where(state[..., 1] > 0, 1.0, -1.0) * (2 * number))[..., None]


CONTROL = {
    "CartPole-v1": (25, lambda state, number: (number < 0.5).astype(jnp.int32)),
    "Acrobot-v1": (160, functools.partial(push_along, velocity=3)),
    "MountainCar-v0": (120, functools.partial(push_along, velocity=1)),
    "MountainCarContinuous-v0": (110, force_along),
    "Pendulum-v1": (200, lambda state, number: (6 * number - 3)[..., None]),
}


@pytest.mark.parametrize("id", CONTROL)
def test_control_environments_step_as_gymnasium(id: str) -> None:
    limit, behave = CONTROL[id]
    mine = trace(factory(id)(), limit, behave)
    unwrapped = gymnasium.make(id).unwrapped
    theirs = TimeLimit(unwrapped, limit)
    unwrapped.reset(seed=0)
    results = []
    for state, clock, action in zip(mine.state, mine.clock, mine.action, strict=True):
        unwrapped.state = state if id == "MountainCarContinuous-v0" else state.astype(np.float64)
        unwrapped.steps_beyond_terminated = None
        theirs._elapsed_steps = int(clock)
        results.append(theirs.step(action if action.ndim else int(action))[:4])
    next_obs, reward, terminated, truncated = (np.array(column) for column in zip(*results, strict=True))
    np.testing.assert_allclose(mine.next_obs, next_obs, rtol=1e-5, atol=3e-6)
    np.testing.assert_allclose(mine.reward, reward, rtol=1e-5, atol=3e-6)
    np.testing.assert_array_equal(mine.terminated, terminated)
    np.testing.assert_array_equal(mine.truncated, truncated)
    assert truncated.any() and terminated.any() == (id != "Pendulum-v1"), "the run shows every kind of ending"


TABLES = {
    "FrozenLake-v1": {},
    "FrozenLake8x8-v1": {},
    "FrozenLake-v1 on a random map": {"desc": generate_random_map(size=6, p=0.7, seed=3), "success_rate": 0.55},
    "CliffWalking-v1": {},
    "CliffWalkingSlippery-v1": {},
    "Taxi-v4": {},
    "Taxi-v4 in the rain": {"is_rainy": True},
}


@functools.cache
def make_table_environment(name: str) -> gymnasium.Env:
    return gymnasium.make(name.split()[0], **TABLES[name])


@functools.cache
def table_of(name: str) -> Table:
    return read_table(make_table_environment(name))


def anything(state: jax.Array, number: jax.Array, actions: int) -> jax.Array:
    return (number * actions).astype(jnp.int32)


@pytest.mark.parametrize("name", TABLES)
def test_tables_step_as_gymnasium(name: str) -> None:
    environment = make_table_environment(name)
    table = table_of(name)
    mine = trace(table_dynamics(table), None, functools.partial(anything, actions=table.reward.shape[1]))
    unwrapped, limit = environment.unwrapped, environment.spec.max_episode_steps
    theirs = unwrapped if limit is None else TimeLimit(unwrapped, limit)
    unwrapped.reset(seed=0)
    model = unwrapped.P
    results = []
    for state, clock, action, *outcome in zip(
        mine.state, mine.clock, mine.action, mine.next_obs, mine.reward, mine.terminated, strict=True
    ):
        possible = [values for values in model[state][action] if list(values[1:]) == outcome and values[0] > 0]
        assert possible, f"{outcome} does not follow {state} under {action}"
        unwrapped.s, unwrapped.P = int(state), {state: {action: [(1.0, *possible[0][1:])]}}
        if limit is not None:
            theirs._elapsed_steps = int(clock)
        results.append(theirs.step(action)[:4])
    unwrapped.P = model
    next_obs, reward, terminated, truncated = (np.array(column) for column in zip(*results, strict=True))
    np.testing.assert_array_equal(mine.next_obs, next_obs)
    np.testing.assert_allclose(mine.reward, reward, rtol=1e-6)
    np.testing.assert_array_equal(mine.terminated, terminated)
    np.testing.assert_array_equal(mine.truncated, truncated)
    assert unwrapped.initial_state_distrib[mine.obs[terminated | truncated]].min(initial=1) > 0


def excess(counts: np.ndarray, expected: np.ndarray) -> float:
    """Chi-squared over all rows of a table of counts, as standard deviations above its mean."""
    seen = expected > 0
    assert counts[~seen].sum() == 0, "what has no probability never happens"
    statistic = (np.square(counts - expected)[seen] / expected[seen]).sum()
    freedom = seen.sum() - (seen.sum(axis=-1) > 0).sum()
    return (statistic - freedom) / np.sqrt(2 * freedom) if freedom else 0.0


def sweep(table: Table, draws: int) -> tuple[np.ndarray, ...]:
    """Successor, reward, terminated of every (state, action) pair, ``[draws, S, A]``, on the compiled environment."""
    dynamics = table_dynamics(table)
    states, actions = table.reward.shape[:2]

    @jax.jit
    def run(key: jax.Array) -> tuple:
        shape = (draws, states, actions)
        state = jnp.broadcast_to(jnp.arange(states, dtype=jnp.int32)[None, :, None], shape)
        action = jnp.broadcast_to(jnp.arange(actions, dtype=jnp.int32)[None, None, :], shape)
        return dynamics.step(state, action, dynamics.draw_step(key, shape))

    return tuple(np.asarray(leaf) for leaf in run(jax.random.key(3)))


def check_distribution(table: Table, model: dict, draws: int) -> None:
    """Successor, reward and ending of every pair occur as often as ``P`` says, and what it does not list never."""
    rewards = np.unique([outcome[2] for row in model.values() for outcomes in row.values() for outcome in outcomes])
    successor, reward, terminated = sweep(table, draws)
    states, actions = table.reward.shape[:2]
    shape = (states * actions, states, len(rewards), 2)
    pair = np.broadcast_to(np.arange(shape[0]).reshape(states, actions), successor.shape)
    places = np.ravel_multi_index((pair, successor, np.searchsorted(rewards, reward), terminated.astype(int)), shape)
    counts = np.bincount(places.ravel(), minlength=np.prod(shape)).reshape(shape[0], -1)
    expected = np.zeros(shape)
    for s, a in np.ndindex(states, actions):
        for chance, after, worth, ended in model[s][a]:
            expected[s * actions + a, after, np.searchsorted(rewards, worth), int(ended)] += draws * chance
    assert np.isin(reward, rewards).all()
    assert abs(excess(counts, expected.reshape(shape[0], -1))) < 4


@pytest.mark.parametrize("name", TABLES)
def test_tables_follow_the_probabilities_of_every_state_and_action(name: str) -> None:
    environment = make_table_environment(name)
    table = table_of(name)
    check_distribution(table, environment.unwrapped.P, 20 if table.probabilities.max(axis=2).min() == 1 else 100)


def test_a_table_too_fine_for_common_intervals_follows_its_probabilities() -> None:
    rng = np.random.default_rng(0)
    probabilities = rng.dirichlet(np.ones(5), size=(150, 4))
    probabilities[0, 0] = [0, 1, 0, 0, 0]
    successors = np.argsort(rng.random((150, 4, 150)))[:, :, :5].astype(np.int32)
    reward = rng.integers(0, 9, (150, 4, 5)).astype(float)
    table = Table(probabilities, successors, reward, successors == 7, np.full(150, 1 / 150))
    model = {
        s: {a: list(zip(probabilities[s, a], successors[s, a], reward[s, a], successors[s, a] == 7, strict=True)) for a in range(4)}
        for s in range(150)
    }
    check_distribution(table, model, 300)


@pytest.mark.parametrize("weights", [[1, 1, 0, 1], [1, 2, 0, 5]])
def test_tables_start_as_their_initial_distribution_says(weights: list[int]) -> None:
    initial = np.array(weights) / sum(weights)
    one = np.ones((4, 1, 1))
    dynamics = table_dynamics(Table(one, np.zeros((4, 1, 1), np.int32), one, one > 0, initial))
    starts = np.asarray(dynamics.reset(dynamics.draw_reset(jax.random.key(0), (8000,))))
    assert abs(excess(np.bincount(starts, minlength=4), 8000 * initial)) < 4


def test_environments_that_are_not_their_table_are_refused() -> None:
    flat = gymnasium.wrappers.TransformReward(gymnasium.make("FrozenLake-v1"), lambda reward: 2 * reward)
    for environment, reason in (
        (gymnasium.make("Blackjack-v1"), "initial_state_distrib"),
        (gymnasium.make("Taxi-v4", fickle_passenger=True), "fickle_passenger=False"),
        (flat, "TransformReward"),
    ):
        assert not has_table(environment)
        with pytest.raises(UserError, match=reason):
            read_table(environment)
    assert has_table(gymnasium.make("Taxi-v4"))


class Cards:
    """Stands in for Gymnasium's random generator: deals the cards it was given."""

    def __init__(self, cards: list[int]) -> None:
        self.cards = iter(cards)

    def choice(self, deck: list[int]) -> int:
        card = next(self.cards)
        assert card in deck
        return card


def hand_of(total: int, ace: bool, natural: bool) -> list[int]:
    """Cards that are such a hand to Gymnasium, which looks at the sum, at an ace and at a natural only."""
    if natural:
        return [1, 10]
    return [1, total - 3, 2] if ace and total > 3 else [1] * total if ace else [total]


RULES = {"sab": {"sab": True}, "natural": {"sab": False, "natural": True}, "plain": {"sab": False, "natural": False}}


@pytest.mark.parametrize("rules", RULES)
def test_blackjack_plays_as_gymnasium_with_the_same_cards(rules: str) -> None:
    dynamics = blackjack(**RULES[rules])
    hands = trace(dynamics, None, lambda state, number: (number < 0.6).astype(jnp.int32)).state
    rng = np.random.default_rng(1)
    theirs = reference_blackjack.BlackjackEnv(**RULES[rules])
    thresholds = np.cumsum(dealer_distribution(), axis=1)
    actions = rng.integers(0, 2, len(hands.total))
    results, words = [], []
    for total, ace, natural, dealer, action in zip(*hands, actions, strict=True):
        deck = rng.choice(reference_blackjack.deck, 13).tolist()
        rank = int(rng.integers(13))
        theirs.player = hand_of(int(total), bool(ace), bool(natural))
        theirs.dealer = [int(dealer), deck.pop()]
        theirs._np_random = Cards([min(rank + 1, 10)] if action else deck)
        observation, reward, terminated, truncated, _ = theirs.step(int(action))
        results.append((*observation, reward, terminated or truncated))
        final = reference_blackjack.score(theirs.dealer)
        outcome = 6 if reference_blackjack.is_natural(theirs.dealer) else max(final - 16, 0)
        ends = np.append(0, thresholds[dealer - 1])
        words.append((rank + 0.5) / 13 if action else (ends[outcome] + ends[outcome + 1]) / 2)
    noise = jnp.asarray((np.array(words) * 2**32).astype(np.uint32))
    after, reward, terminated = jax.jit(dynamics.step)(jax.tree.map(jnp.asarray, hands), jnp.asarray(actions, jnp.int32), noise)
    np.testing.assert_array_equal(np.stack([*dynamics.observe(after), reward, terminated], axis=1), np.array(results, float))
    assert np.unique(np.array(results)[:, 3]).size == (4 if rules == "natural" else 3)


def dealt_to_the_end(hand: list[int], chance: float, outcomes: np.ndarray) -> None:
    """Adds the chances of the dealer's outcomes from this hand, by Gymnasium's own rules."""
    if len(hand) > 1 and reference_blackjack.sum_hand(hand) >= 17:
        natural = reference_blackjack.is_natural(hand)
        outcomes[6 if natural else max(reference_blackjack.score(hand) - 16, 0)] += chance
        return
    for card in range(1, 11):
        dealt_to_the_end([*hand, card], chance * (4 if card == 10 else 1) / 13, outcomes)


def test_blackjack_dealer_ends_as_gymnasium_deals() -> None:
    expected = np.zeros((10, 7))
    for card in range(1, 11):
        dealt_to_the_end([card], 1.0, expected[card - 1])
    np.testing.assert_allclose(dealer_distribution(), expected, atol=1e-12)


def test_blackjack_deals_independent_cards() -> None:
    hand: Hand = deal(jax.random.bits(jax.random.key(5), (40_000,), jnp.uint32))
    assert np.all(np.asarray(hand.natural) == (np.asarray(hand.ace) & (np.asarray(hand.total) == 11)))
    chance = np.array([1.0] * 9 + [4.0]) / 13
    totals = np.convolve(np.append(0, chance), np.append(0, chance))
    counts = np.zeros((21, 11))
    np.add.at(counts, (np.asarray(hand.total), np.asarray(hand.dealer)), 1)
    assert abs(excess(counts.reshape(1, -1), 40_000 * np.outer(totals, np.append(0, chance)).reshape(1, -1))) < 4
