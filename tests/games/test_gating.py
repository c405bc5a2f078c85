"""The gate: its match is that of a slow loop, the stronger side passes and the weaker does not, and without a match nothing happens."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.games.environment import opening
from thorndike.games.gating import GateSettings, closed_gate, match_score, try_gate
from thorndike.games.tic_tac_toe import TIC_TAC_TOE

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY, LAST, PAIRS, TRACES = jax.random.key(0), 16, 6, 97


def step(position, action, key):
    """Add 1 or 2, and after a 2 move again."""
    again = action == 1
    player = jnp.where(again, position["player"], 1 - position["player"]).astype(jnp.int32)
    total, trace = (position["total"] + action + 1).astype(jnp.int32), ((31 * position["trace"] + action + 1) % TRACES).astype(jnp.int32)
    return {"total": total, "trace": trace, "player": player, "last": position["player"]}


def rewards(position):
    """Whoever comes to the last number has won."""
    won = jnp.where(jnp.arange(2) == position["last"], 1.0, -1.0)
    return jnp.where(position["total"] >= LAST, won, 0.0)


COUNT = TIC_TAC_TOE._replace(
    id="count",
    num_actions=2,
    max_moves=LAST,
    init=lambda key: {"total": jnp.int32(0), "trace": jnp.int32(0), "player": jnp.int32(0), "last": jnp.int32(0)},
    step=step,
    legal=lambda position: jnp.ones(2, bool),
    player=lambda position: position["player"],
    terminated=lambda position: position["total"] >= LAST,
    rewards=rewards,
)


def by_table(params, positions, key):
    """A move for what was played before, as far as a small number tells it."""
    del key
    return params[positions["trace"]]


def slow_score(first, second, key):
    """One game after another."""
    points = []
    for one in jax.random.split(jax.random.split(key)[0], PAIRS):
        begun = jax.tree.map(int, opening(COUNT, one, 1.0, LAST // 4))
        for of_first in (begun["player"], 1 - begun["player"]):
            total, trace, player = begun["total"], begun["trace"], begun["player"]
            while total < LAST:
                mover = player
                action = int((first if player == of_first else second)[trace])
                total, trace, player = total + action + 1, (31 * trace + action + 1) % TRACES, player if action == 1 else 1 - player
            points.append(float(mover == of_first))
    return np.mean(points)


def test_a_match_is_that_of_a_slow_loop_whoever_moves_twice():
    random, play = np.random.default_rng(0), jax.jit(partial(match_score, COUNT, by_table, games=2 * PAIRS - 1, due=jnp.array(True)))
    scores = set()
    for number in range(8):
        tables, key = jnp.asarray(random.integers(0, 2, (2, TRACES)), jnp.int32), jax.random.key(number)
        found = float(play(tables[0], tables[1], key=key))
        assert found == pytest.approx(slow_score(*np.asarray(tables), key))
        assert float(play(tables[1], tables[0], key=key)) == pytest.approx(1 - found), "colours are swapped"
        assert float(play(tables[0], tables[0], key=key)) == 0.5, "each opening is played by both sides"
        scores.add(found)
    assert len(scores) > 3


def by_skill(params, positions, key):
    """Takes a win where it sees one: in a share of the positions that the parameter says."""

    def wins(position, action):
        after = TIC_TAC_TOE.step(position, action, KEY)
        return TIC_TAC_TOE.terminated(after) & (TIC_TAC_TOE.rewards(after)[TIC_TAC_TOE.player(position)] > 0)

    found = jax.vmap(lambda position: jax.vmap(partial(wins, position))(jnp.arange(9)))(positions)
    noise = jax.random.gumbel(key, found.shape)
    return jnp.argmax(jnp.where(jax.vmap(TIC_TAC_TOE.legal)(positions), 100.0 * params * found + noise, -jnp.inf), axis=-1)


def test_the_stronger_passes_and_the_weaker_does_not():
    settings = GateSettings(every=3, games=200, threshold=0.55)
    attempt = jax.jit(partial(try_gate, TIC_TAC_TOE, by_skill, settings))
    weak, strong = jnp.float32(0.0), jnp.float32(1.0)
    gate = closed_gate(settings, weak)
    for iteration, candidate, best, passed in ((1, strong, 0, 0), (3, weak, 0, 0), (6, strong, 1, 1), (7, weak, 1, 1), (9, weak, 1, 1)):
        before = gate
        gate, told = attempt(gate, candidate, jnp.int32(iteration), jax.random.key(iteration))
        assert (float(gate.best), int(gate.passed)) == (best, passed), iteration
        assert told == {"train/gate_score": gate.score, "train/gates_passed": passed}
        if iteration % 3:
            assert gate.score == before.score
    # Of the matches of 3, 6 and 9: equal, stronger, weaker.
    assert float(gate.score) < 0.4
    assert closed_gate(settings._replace(every=0), weak) is None
    assert try_gate(TIC_TAC_TOE, by_skill, settings, None, weak, jnp.int32(3), KEY) == (None, {})


def test_seeds_side_by_side_are_each_of_them_alone():
    settings = GateSettings(every=1, games=8, threshold=0.5)
    attempt = partial(try_gate, COUNT, by_table, settings)
    tables, keys = jax.random.randint(KEY, (3, TRACES), 0, 2, jnp.int32), jax.random.split(KEY, 3)
    others = jax.random.randint(jax.random.key(1), (3, TRACES), 0, 2, jnp.int32)
    gates = jax.vmap(partial(closed_gate, settings))(tables)
    together = jax.jit(jax.vmap(attempt))(gates, others, jnp.arange(3), keys)[0]
    alone = jax.jit(attempt)
    for i in range(3):
        one = alone(jax.tree.map(lambda leaf, i=i: leaf[i], gates), others[i], jnp.int32(i), keys[i])[0]
        for whole, part in zip(jax.tree.leaves(together), jax.tree.leaves(one), strict=True):
            np.testing.assert_array_equal(whole[i], part)
