"""Games played against oneself: outcomes told backwards, positions packed, boards turned, moves drawn and resigned."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import game_environment, opening
from thorndike.games.game import Game
from thorndike.games.packing import packing
from thorndike.games.search import Found
from thorndike.games.self_play import Manners, as_batch, draw_moves, fresh_memory, move
from thorndike.games.settings import GameSettings
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.games.turns import players
from thorndike.replay.self_play import Rows, add_self_play, init_self_play, outcomes, sample_self_play

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY = jax.random.key(0)
STEPS, GAMES, LENGTH, LONGEST = 24, 3, 4, 9
"""The ring's steps, games side by side, steps written at once, the longest game."""


def written(random: np.random.Generator, number: int) -> tuple[Rows, np.ndarray, np.ndarray]:
    """Steps whose position says when and where they were made; no game is longer than ``LONGEST``."""
    lead = (LENGTH, GAMES)
    when = np.arange(number * LENGTH, (number + 1) * LENGTH, dtype=np.int32)
    position = np.stack([np.repeat(when[:, None], GAMES, 1), np.tile(np.arange(GAMES, dtype=np.int32), (LENGTH, 1))], axis=-1)
    done = (random.random(lead) < 0.2) | (when[:, None] % 7 == 6)
    reward = np.where(done, random.integers(-1, 2, lead), 0).astype(np.float32)
    player = random.integers(0, 2, lead).astype(np.int8)
    zeros = np.zeros(lead, np.float32)
    rows = Rows(position, player, np.zeros((*lead, 2), np.float32), zeros + 1, zeros, zeros > 0, zeros > 0)
    return jax.tree.map(jnp.asarray, rows), reward, done


def test_outcomes_reach_back_to_the_beginnings_of_games_and_no_further():
    random = np.random.default_rng(0)
    buffer = init_self_play(STEPS, GAMES, 2, 2)
    add = jax.jit(partial(add_self_play, longest=LONGEST))
    history: list[tuple] = []
    for number in range(20):
        rows, reward, done = written(random, number)
        buffer = add(buffer, rows, jnp.asarray(reward), jnp.asarray(done))
        history += [(np.asarray(rows.player[t]), reward[t], done[t]) for t in range(LENGTH)]
        expected = {}
        for game in range(GAMES):
            ending = None
            for when in reversed(range(len(history))):
                player, paid, over = (x[game] for x in history[when])
                if over:
                    ending = paid if player == 0 else -paid
                expected[when, game] = None if ending is None else (ending if player == 0 else -ending)
        stored = jax.tree.map(np.asarray, buffer.rows)
        assert int(buffer.size) == min((number + 1) * LENGTH, STEPS)
        for row in range(int(buffer.size)):
            for game in range(GAMES):
                when = int(stored.position[row, game, 0])
                assert when >= len(history) - STEPS
                known = expected[when, game]
                assert stored.known[row, game] == (known is not None)
                assert known is None or stored.outcome[row, game] == known


def test_outcomes_of_one_batch_by_hand():
    player = jnp.array([[0], [1], [0], [1], [0]], jnp.int8)
    reward = jnp.array([[0.0], [1.0], [0.0], [0.0], [0.0]])
    found = outcomes(player, reward, reward > 0)
    assert found.known[:, 0].tolist() == [True, True, False, False, False]
    assert found.outcome[:2, 0].tolist() == [-1.0, 1.0]


def test_rows_are_drawn_evenly_from_what_is_stored():
    random = np.random.default_rng(0)
    buffer = init_self_play(STEPS, GAMES, 2, 2)
    for number in range(8):
        rows, reward, done = written(random, number)
        buffer = add_self_play(buffer, rows, jnp.asarray(reward), jnp.asarray(done), LONGEST)
    drawn = np.asarray(sample_self_play(buffer, KEY, 20_000).position)
    counts = np.unique(drawn, axis=0, return_counts=True)[1]
    assert len(counts) == STEPS * GAMES and abs(counts / counts.mean() - 1).max() < 0.25


@pytest.mark.parametrize("game", [TIC_TAC_TOE, CONNECT_FOUR], ids=lambda game: game.id)
def test_positions_are_unpacked_as_they_were(game: Game):
    whole = packing(game)
    positions = jax.vmap(lambda key: opening(game, key, 1.0, game.max_moves // 2))(jax.random.split(KEY, 50))
    numbers = jax.vmap(whole.pack)(positions)
    assert numbers.shape == (50, whole.size) and numbers.dtype == jnp.int32
    assert len(np.unique(numbers, axis=0)) > 10
    for before, after in zip(jax.tree.leaves(positions), jax.tree.leaves(jax.vmap(whole.unpack)(numbers)), strict=True):
        np.testing.assert_array_equal(before, after)
        assert before.dtype == after.dtype


def test_positions_of_any_arrays_are_packed():
    def init(key):
        return {"key": key, "bytes": jnp.arange(4, dtype=jnp.int8), "flag": jnp.array(True), "number": jnp.float32(1.5)}

    whole = packing(TIC_TAC_TOE._replace(init=init))
    before = init(jax.random.key(7))
    after = whole.unpack(whole.pack(before))
    assert (jax.random.key_data(after["key"]) == jax.random.key_data(before["key"])).all()
    assert after["bytes"].tolist() == [0, 1, 2, 3] and after["bytes"].dtype == jnp.int8
    assert bool(after["flag"]) is True and float(after["number"]) == 1.5


def test_an_equal_part_of_a_batch_is_turned_each_way_policy_and_board_together():
    game = TIC_TAC_TOE
    position = game.init(KEY)
    for action in (1, 2):
        position = game.step(position, jnp.int32(action), KEY)
    count = 16
    numbers = jnp.tile(packing(game).pack(position)[None], (count, 1))
    policy = jnp.tile((jnp.arange(9) / 36.0)[None], (count, 1))
    ones = jnp.ones((count,))
    rows = Rows(numbers, jnp.zeros((count,), jnp.int8), policy, ones, ones, ones > 0, ones < 0)
    plain, turned = as_batch(game, rows, symmetries=False), as_batch(game, rows, symmetries=True)
    assert len(np.unique(turned.board, axis=0)) == 8 and len(np.unique(plain.board, axis=0)) == 1
    for i in range(count):
        way = i % 8
        board = plain.board[i] if way == 0 else game.symmetries[way - 1].observation(plain.board[i])
        order = np.arange(9) if way == 0 else game.symmetries[way - 1].actions
        np.testing.assert_array_equal(turned.board[i], board)
        np.testing.assert_array_equal(turned.policy[i], policy[i][order])
        # Where a piece is, no move is legal: board and moves were turned alike.
        np.testing.assert_array_equal(turned.legal[i].reshape(3, 3), ~(turned.board[i] > 0).any(axis=-1))


def found(values: list[float]) -> Found:
    policy = jnp.tile(jnp.array([[0.7, 0.2, 0.1]]), (len(values), 1))
    action = jnp.zeros((len(values),), jnp.int32)
    return Found(action, policy, jnp.array(values), (10 * policy).astype(jnp.int32), action[:, None])


def test_the_first_moves_are_drawn_by_the_policy_and_the_later_ones_are_the_best():
    manners = Manners(1.0, 2, -1.0, 0.0, 1.0)
    count = 4_000
    noise = jax.tree.map(lambda x: x[0], draw_moves(KEY, 1, count, 3, manners))
    early = move(found([0.0] * count), fresh_memory(count), noise, manners)
    shares = np.bincount(early.action, minlength=3) / count
    np.testing.assert_allclose(shares, [0.7, 0.2, 0.1], atol=0.03)
    memory = early.memory._replace(moves=early.memory.moves + 1)
    assert (move(found([0.0] * count), memory, noise, manners).action == 0).all()
    cold = move(found([0.0] * count), fresh_memory(count), noise, manners._replace(temperature=0.1))
    assert (cold.action == 0).mean() > 0.99


def test_lost_games_are_resigned_but_for_the_share_that_is_played_on():
    manners = Manners(1.0, 0, -0.9, 0.25, 1.0)
    count = 2_000
    noise = jax.tree.map(lambda x: x[0], draw_moves(KEY, 1, count, 3, manners))
    moved = move(found([-0.95, 0.5] * (count // 2)), fresh_memory(count), noise, manners)
    lost = np.arange(count) % 2 == 0
    assert (moved.action[~lost] == 0).all() and not moved.resigns[~lost].any()
    assert set(np.unique(moved.action[lost])) == {0, 3}
    np.testing.assert_array_equal(moved.action[lost] == 0, moved.resigns[lost])
    assert abs(moved.resigns[lost].mean() - 0.25) < 0.05
    later = move(found([-0.95] * count), moved.memory, jax.tree.map(jnp.zeros_like, noise), manners)
    np.testing.assert_array_equal(later.resigns, moved.memory.plays_on)


def test_the_environment_plays_on_rewards_the_mover_and_begins_anew():
    environment = game_environment(TIC_TAC_TOE, 16, GameSettings(opening_share=0.5, opening_plies=3))
    state, obs = environment.init(KEY)
    step = jax.jit(environment.step)
    noise = environment.draw(jax.random.key(1), 30)
    random = np.random.default_rng(0)
    ends = openings = 0
    for t in range(30):
        legal = np.asarray(obs["action_mask"])
        assert (legal.sum(axis=1) == 9 - np.asarray(obs["board"]).sum(axis=(1, 2, 3))).all()
        mover = np.asarray(players(TIC_TAC_TOE, obs["position"][None])[0])
        action = np.array([random.choice(np.flatnonzero(row)) for row in legal], np.int32)
        resigned = random.random(16) < 0.05
        state, result = step(state, np.where(resigned, 9, action).astype(np.int32), jax.tree.map(lambda x, t=t: x[t], noise))
        done = np.asarray(result.terminated)
        assert (np.asarray(result.reward)[resigned] == -1).all() and done[resigned].all()
        assert not np.asarray(result.truncated).any() and np.asarray(result.valid).all()
        assert (np.asarray(result.reward)[~resigned] >= 0).all(), "nobody loses by a move of his own"
        assert (np.asarray(result.reward)[~done] == 0).all()
        goes_on = ~done
        following = np.asarray(players(TIC_TAC_TOE, result.obs["position"][None])[0])
        assert (following[goes_on] == 1 - mover[goes_on]).all()
        fresh = np.asarray(result.obs["board"]).sum(axis=(1, 2, 3))[done]
        assert (fresh <= 3).all()
        ends, openings = ends + done.sum(), openings + (fresh > 0).sum()
        obs = result.obs
    assert ends > 20 and 0 < openings < ends
