"""Blackjack as a table, so that planning gives its exact value: the dealer's play becomes probabilities of outcomes.

State: the number of the observation (player's total, dealer's card, usable ace) in mixed radix 32 x 11 x 2, as `functional.state_index`
counts. A natural shows the same observation as any other soft 21 but pays differently, so it has states of its own: 704 + dealer's card.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from thorndike.environments.native.blackjack import BEST, FACE_VALUE, RANKS, Hand, dealer_distribution, payout
from thorndike.environments.native.table import Table

OBSERVATIONS = 32 * 11 * 2
STATES = OBSERVATIONS + FACE_VALUE + 1
STICK, HIT = 0, 1
DEALER_CARDS = range(1, FACE_VALUE + 1)
TOTALS = [(total, False) for total in range(4, BEST + 1)] + [(total, True) for total in range(2, 12)]
"""Player's totals with aces as 1, without and with a usable ace."""
CARD_CHANCES = np.array([1] * (FACE_VALUE - 1) + [RANKS - FACE_VALUE + 1]) / RANKS
"""Probability of each card value 1 to 10."""


class Cards(NamedTuple):
    """A hand on the host: see `Hand`."""

    total: int
    ace: bool
    natural: bool
    dealer: int


def blackjack_table(*, natural: bool = False, sab: bool = True) -> Table:
    """The transition model of Blackjack-v1 with Gymnasium's settings, as in `blackjack`. States no hand reaches end at once."""
    shape = (STATES, 2, FACE_VALUE)
    table = Table(np.zeros(shape), np.zeros(shape, np.int32), np.zeros(shape), np.ones(shape, np.bool_), _deal(), "Blackjack-v1")
    table.probabilities[:, :, 0] = 1.0
    hands = [Cards(total, ace, False, dealer) for dealer in DEALER_CARDS for total, ace in TOTALS]
    hands += [Cards(11, True, True, dealer) for dealer in DEALER_CARDS]
    finish = dealer_distribution()
    columns = Hand(*(jnp.array(column)[:, None] for column in zip(*hands, strict=True)))
    payouts = np.asarray(payout(columns, jnp.arange(finish.shape[1])[None], natural=natural, sab=sab))
    for hand, rewards in zip(hands, payouts, strict=True):
        _fill(table, hand, finish[hand.dealer - 1], rewards)
    return table


def _fill(table: Table, hand: Cards, chances: Float[np.ndarray, "7"], rewards: Float[np.ndarray, "7"]) -> None:
    """Both actions in the state of one hand."""
    state = _number(hand)
    table.probabilities[state, STICK, : len(chances)] = chances
    table.reward[state, STICK, : len(rewards)] = rewards
    for card, chance in enumerate(CARD_CHANCES, start=1):
        drawn, entry = Cards(hand.total + card, hand.ace or card == 1, False, hand.dealer), (state, HIT, card - 1)
        bust = drawn.total > BEST
        table.probabilities[entry] = chance
        table.terminated[entry], table.reward[entry] = bust, -float(bust)
        table.next_state[entry] = state if bust else _number(drawn)


def _deal() -> Float[np.ndarray, " S"]:
    """Distribution over states after two cards to the player and one to the dealer."""
    initial = np.zeros(STATES)
    cards = list(enumerate(CARD_CHANCES, start=1))
    for (first, p), (second, q), (dealer, r) in itertools.product(cards, repeat=3):
        hand = Cards(first + second, 1 in (first, second), {first, second} == {1, FACE_VALUE}, dealer)
        initial[_number(hand)] += p * q * r
    return initial


def _number(hand: Cards) -> int:
    """The state of a hand."""
    if hand.natural:
        return OBSERVATIONS + hand.dealer
    usable = hand.ace and hand.total + 10 <= BEST
    return ((hand.total + 10 * usable) * 11 + hand.dealer) * 2 + usable
