"""Othello of our own: step by step the game that pgx plays; its rules against slow Python are in test_pgx_games.py."""

import jax
import numpy as np
import pgx

from thorndike.games.othello import OTHELLO

GAMES = 256


def test_random_games_are_those_of_pgx():
    theirs = pgx.make("othello")
    with jax.numpy_rank_promotion("allow"):
        their_init, their_step = jax.jit(jax.vmap(theirs.init)), jax.jit(jax.vmap(theirs.step))
        key, random = jax.random.key(0), np.random.default_rng(0)
        state = their_init(jax.random.split(key, GAMES))
        # pgx draws who moves first.
        first = np.asarray(state.current_player)
        position = jax.vmap(OTHELLO.init)(jax.random.split(key, GAMES))
        step = jax.jit(jax.vmap(lambda position, action: OTHELLO.step(position, action, key)))
        look = jax.jit(
            jax.vmap(lambda p: (OTHELLO.legal(p), OTHELLO.player(p), OTHELLO.terminated(p), OTHELLO.rewards(p), OTHELLO.observe(p)))
        )
        alive, compared, passed = np.ones(GAMES, bool), 0, 0
        while alive.any():
            legal, player, over, rewards, seen = map(np.asarray, look(position))
            their_rewards = np.where(first[:, None] == 0, state.rewards, np.asarray(state.rewards)[:, ::-1])
            np.testing.assert_array_equal(over[alive], np.asarray(state.terminated)[alive])
            np.testing.assert_array_equal(rewards[alive], their_rewards[alive])
            np.testing.assert_array_equal(player[alive], (np.asarray(state.current_player) ^ first)[alive])
            np.testing.assert_array_equal(seen[alive], np.asarray(state.observation, np.float32)[alive])
            compared += int(alive.sum())
            alive &= ~over
            np.testing.assert_array_equal(legal[alive], np.asarray(state.legal_action_mask)[alive])
            passed += int(legal[alive, 64].sum())
            actions = np.array([random.choice(np.flatnonzero(row)) for row in legal], np.int32)
            state, position = their_step(state, actions), step(position, actions)
    assert compared > 10_000
    assert passed > 50
    assert {tuple(row) for row in rewards.tolist()} >= {(1, -1), (-1, 1)}
