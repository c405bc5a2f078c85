"""What a learner sees that is not told the rules, and sequences on turned boards: the same game, played on."""

import jax
import jax.numpy as jnp
import numpy as np

import tic_tac_toe_lines as lines
from thorndike.games.board_view import turned, view_of
from thorndike.games.environment import game_environment
from thorndike.games.tic_tac_toe import TIC_TAC_TOE, TicTacToePosition
from thorndike.replay.unrolled import Unrolled

KEY = jax.random.key(0)
observe = jax.vmap(TIC_TAC_TOE.observe)


def played(position: TicTacToePosition, moves) -> TicTacToePosition:
    for move in moves:
        position = jax.vmap(lambda p, a: TIC_TAC_TOE.step(p, a, KEY))(position, move)
    return position


def test_of_a_game_the_board_is_seen_and_not_the_position():
    environment = game_environment(TIC_TAC_TOE, 3)
    view = view_of(environment.spec, 9)
    _, obs = environment.init(KEY)
    seen = view.see(obs)
    assert set(seen) == set(view.space.spaces) == {"board", "action_mask"}
    np.testing.assert_array_equal(seen["board"], obs["board"].reshape(3, -1))
    np.testing.assert_array_equal(view.legal(seen), obs["action_mask"] > 0)
    over_time = view.see(jax.tree.map(lambda x: jnp.stack([x, x]), obs))
    assert over_time["board"].shape == (2, 3, view.space["board"].shape[0])


def test_moves_on_a_turned_board_lead_to_the_turned_position():
    ways, count = len(TIC_TAC_TOE.symmetries) + 1, 16
    start = lines.batch([(0b1, 0b10)] * count)
    actions = jnp.tile(jnp.array([[2], [4], [8]], jnp.int32), (1, count))
    policy = jax.nn.one_hot(actions, 9)
    flat = observe(start).reshape(count, -1)
    obs = {"board": flat, "action_mask": jax.vmap(TIC_TAC_TOE.legal)(start).astype(jnp.int8)}
    nothing, flags = jnp.zeros((4, count)), jnp.zeros((4, count), bool)
    batch = turned(TIC_TAC_TOE, Unrolled(obs, actions[:2], policy, nothing, flags, flags, nothing, obs, (), jnp.ones(count)))
    assert len({np.asarray(board).tobytes() for board in batch.obs["board"]}) == ways
    # Where the pieces of a turned board are: channel 0 is the mover's.
    boards = np.asarray(batch.obs["board"]).reshape(count, 9, -1) > 0
    pieces = [tuple(int(sum(1 << int(i) for i in np.flatnonzero(board[:, who]))) for who in (0, 1)) for board in boards]
    end = observe(played(lines.batch(pieces), batch.action))
    expected = observe(played(start, actions[:2]))
    for m in range(count):
        way = m % ways
        symmetric = expected[m] if way == 0 else TIC_TAC_TOE.symmetries[way - 1].observation(expected[m])
        np.testing.assert_array_equal(end[m], symmetric)
        np.testing.assert_array_equal(np.flatnonzero(batch.policy[0, m]), [int(batch.action[0, m])])
        assert batch.obs["action_mask"][m].sum() == 7 and batch.obs["action_mask"][m, batch.action[0, m]] == 1
