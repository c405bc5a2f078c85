"""Blackjack-v1: hit or stick against a dealer who draws to 17, from an infinite deck, as in Gymnasium 1.4.0.

Sutton and Barto, 2018, example 5.1. Observation: the tuple (player's total 4 to 31, dealer's card 1 to 10, usable ace 0 or 1), int32.
The dealer's hidden card and draws matter only when the player sticks, so nothing keeps them: the dealer's final score comes from its
exact distribution given the card that shows. One word of noise a step serves both, the card of a hit or the dealer's score after a stick.
"""

import functools
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int32, UInt32

from thorndike.environments.native.randomness import draw_words, uniforms, unit_interval
from thorndike.environments.native.vectorize import Dynamics

RANKS = 13
FACE_VALUE = 10
DEALER_STANDS = 17
BEST = 21
DEALER_SCORES = (0, 17, 18, 19, 20, 21, 21)
"""The dealer's outcomes: bust, 17 to 21, and last the natural (21 with two cards)."""
DEALER_NATURAL = 6

Observation: TypeAlias = tuple[Int32[Array, "*batch"], Int32[Array, "*batch"], Int32[Array, "*batch"]]


class Hand(NamedTuple):
    """What the player holds and sees."""

    total: Int32[Array, "*batch"]
    """Sum of the player's cards, aces as 1."""
    ace: Bool[Array, "*batch"]
    natural: Bool[Array, "*batch"]
    """An ace and a ten, and nothing drawn since."""
    dealer: Int32[Array, "*batch"]
    """The dealer's card that shows."""


def blackjack(*, natural: bool = False, sab: bool = True) -> Dynamics:
    """Blackjack-v1 with Gymnasium's settings.

    ``sab``: the book's rules (a natural wins unless the dealer has one). ``natural``: without ``sab``, a winning natural pays 1.5. The
    defaults are those Gymnasium registers.
    """
    thresholds = jnp.asarray(np.cumsum(dealer_distribution(), axis=1)[:, :-1], jnp.float32)

    def step(hand: Hand, action: Int32[Array, "*batch"], words: UInt32[Array, "*batch"]) -> tuple[Hand, Array, Array]:
        number = unit_interval(words)
        hit = action != 0
        drawn = _draw(hand, number)
        bust = drawn.total > BEST
        outcome = jnp.sum(number[..., None] >= thresholds[hand.dealer - 1], axis=-1, dtype=jnp.int32)
        stuck = payout(hand, outcome, natural=natural, sab=sab)
        after = Hand(*(jnp.where(hit, new, old) for new, old in zip(drawn, hand, strict=True)))
        return after, jnp.where(hit, -bust.astype(jnp.float32), stuck), jnp.where(hit, bust, True)

    return Dynamics(
        reset=deal,
        observe=observe,
        step=step,
        draw_reset=draw_words,
        draw_step=draw_words,
        observation_space=spaces.Tuple((spaces.Discrete(32), spaces.Discrete(11), spaces.Discrete(2))),
        action_space=spaces.Discrete(2),
        id="Blackjack-v1",
    )


def deal(words: UInt32[Array, "*batch"]) -> Hand:
    """Two cards to the player and the dealer's first."""
    ranks = uniforms(words, 3, 0.0, float(RANKS)).astype(jnp.int32)
    cards = jnp.minimum(ranks + 1, FACE_VALUE)
    first, second = cards[..., 0], cards[..., 1]
    ace = (first == 1) | (second == 1)
    return Hand(first + second, ace, ace & (first + second == 11), cards[..., 2])


def observe(hand: Hand) -> Observation:
    """Total with a usable ace as 11, the dealer's card, whether there is a usable ace."""
    return score(hand), hand.dealer, usable_ace(hand).astype(jnp.int32)


def usable_ace(hand: Hand) -> Bool[Array, "*batch"]:
    """Whether an ace can count as 11."""
    return hand.ace & (hand.total + 10 <= BEST)


def score(hand: Hand) -> Int32[Array, "*batch"]:
    """The player's total, a usable ace as 11."""
    return jnp.where(usable_ace(hand), hand.total + 10, hand.total)


def payout(hand: Hand, outcome: Int32[Array, "*batch"], *, natural: bool, sab: bool) -> Float[Array, "*batch"]:
    """Reward of sticking when the dealer ends with ``DEALER_SCORES[outcome]``."""
    dealer = jnp.where(outcome == 0, 0, jnp.minimum(outcome + 16, BEST))
    reward = jnp.sign(score(hand) - dealer).astype(jnp.float32)
    if sab:
        return jnp.where(hand.natural & (outcome != DEALER_NATURAL), jnp.float32(1), reward)
    return jnp.where(hand.natural & (reward == 1), jnp.float32(1.5), reward) if natural else reward


def dealer_distribution() -> np.ndarray:
    """Probability of each outcome (columns) given the card that shows (rows 0 to 9 for 1 to 10): ``float64[10, 7]``, exact."""
    return np.array([_finish(card, card == 1, 1) for card in range(1, FACE_VALUE + 1)])


@functools.cache
def _finish(total: int, ace: bool, cards: int) -> tuple[float, ...]:
    """Distribution of the dealer's outcome from a hand with this total (aces as 1)."""
    best = total + 10 if ace and total + 10 <= BEST else total
    if best >= DEALER_STANDS and cards > 1:
        natural = best == BEST and cards == 2
        outcome = DEALER_NATURAL if natural else best - 16 if best <= BEST else 0
        return tuple(float(i == outcome) for i in range(len(DEALER_SCORES)))
    values = [min(rank, FACE_VALUE) for rank in range(1, RANKS + 1)]
    ends = [_finish(total + value, ace or value == 1, cards + 1) for value in values]
    return tuple(sum(column) / RANKS for column in zip(*ends, strict=True))


def _draw(hand: Hand, number: Float[Array, "*batch"]) -> Hand:
    """The hand after one more card."""
    card = jnp.minimum((number * RANKS).astype(jnp.int32) + 1, FACE_VALUE)
    return Hand(hand.total + card, hand.ace | (card == 1), jnp.zeros_like(hand.natural), hand.dealer)
