"""Games of pgx, and Othello: rules against slow Python and python-chess, who moves first, names, clicks, symmetries, versions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from games.rules import KEY, Compiled, SlowGo, SlowHex, SlowOthello
from thorndike.errors import UserError
from thorndike.games import pgx_games
from thorndike.games.environment import game_environment
from thorndike.games.game import named_action
from thorndike.games.registry import ADAPTED_GAMES, FOR_ONE, WITH_DICE, game

SLOW_RULES = {"othello": SlowOthello, "go_9x9": lambda: SlowGo(9), "hex": SlowHex}
QUICK = ["othello", "hex", "go_9x9"]
LATE = ["go_19x19", "gardner_chess", "animal_shogi", "backgammon", "2048", "chess", "shogi"]
"""They compile for long."""


@pytest.fixture(scope="module", params=[*QUICK, *(pytest.param(id, marks=pytest.mark.slow) for id in LATE)])
def compiled(request, quick_compile):
    return Compiled(game(request.param))


@pytest.mark.parametrize("id", [*FOR_ONE, *WITH_DICE, "othello"])
def test_games_for_one_and_games_with_dice_are_known_before_they_are_made(id):
    made = game(id)
    assert (made.num_players == 1) == (id in FOR_ONE)
    assert (made.num_players == 2 and made.has_chance) == (id in WITH_DICE)


def random_moves(random, compiled, most=10**9):
    """A random game: positions that moves are made from, and the move; then the last position and None."""
    position = compiled.init(jax.random.key(int(random.integers(2**31))))
    for ply in range(most):
        legal, _, over, _ = compiled.facts(position)
        if over:
            break
        action = int(random.choice(legal))
        yield position, action
        position = compiled.play(position, action, ply)
    yield position, None


def test_random_games_keep_the_slow_rules(compiled):
    made = compiled.game
    if made.id not in SLOW_RULES:
        return check_any(compiled)
    random = np.random.default_rng(3)
    winners, look = set(), jax.jit(lambda position: (made.ownership(position), made.observe(position)))
    for _ in range({"othello": 6, "hex": 4, "go_9x9": 3}[made.id]):
        slow, moves = SLOW_RULES[made.id](), 0
        for position, action in random_moves(random, compiled):
            legal, player, over, rewards = compiled.facts(position)
            assert over == slow.over
            assert rewards.tolist() == slow.rewards()
            assert made.board(position).rows == slow.rows()
            if made.ownership is not None and (over or moves % 20 == 0):
                owner, seen = (np.asarray(x) for x in look(position))
                assert owner.tolist() == slow.owners()
                # The mover's stones and the other's lie on squares that are theirs, of a board that is not turned with the mover.
                stones = (seen[..., 0] - seen[..., 1]) * (1 - 2 * player)
                np.testing.assert_array_equal(owner[stones != 0], stones[stones != 0])
            if action is not None:
                assert sorted(made.action_name(position, move) for move in legal) == sorted(slow.legal())
                assert player == "XO".index(slow.mover)
                slow.play(made.action_name(position, action))
                moves += 1
        assert moves <= made.max_moves
        assert (made.ownership is None) == (made.id == "hex") and made.komi == (7.5 if made.id == "go_9x9" else 0)
        winners.add(tuple(rewards))
    assert len(winners) > 1
    return None


def check_any(compiled):
    """What holds of every game."""
    made = compiled.game
    random = np.random.default_rng(4)
    for number in range(2):
        for ply, (position, action) in enumerate(random_moves(random, compiled, 200 if made.id == "go_19x19" else 800)):
            _, player, over, rewards = compiled.facts(position)
            if ply == 0:
                assert player == 0
                assert not over
            assert len(rewards) == made.num_players
            if made.num_players == 2:
                assert rewards.sum() == 0
            assert over or rewards.any() == 0 or made.num_players == 1
            if action is None and over and rewards.any() and not made.has_chance and made.id != "animal_shogi":
                # Mate: whoever is to move has lost.
                assert rewards[player] == -1
            assert ply <= made.max_moves, number


def test_names_go_there_and_back_and_clicks_and_buttons_are_the_legal_moves(compiled):
    made = compiled.game
    random = np.random.default_rng(5)
    for ply, (position, action) in enumerate(random_moves(random, compiled, 120)):
        legal, _, over, _ = compiled.facts(position)
        board = made.board(position)
        height, width = len(board.rows), len(board.rows[0])
        assert (height, width) == (len(board.row_names), len(board.column_names))
        meant = [*board.clicks.values(), *board.buttons.values()]
        assert sorted(meant) == ([] if over else legal.tolist())
        assert all(0 <= r < height and 0 <= c < width for click in board.clicks for r, c in click)
        if ply % 10 == 0 and action is not None:
            names = [made.action_name(position, move) for move in legal]
            assert len(set(names)) == len(names)
            assert [named_action(made, position, name) for name in names[:40]] == legal.tolist()[:40]
            assert set(board.buttons.items()) <= {(name, int(move)) for name, move in zip(names, legal, strict=True)}


def test_a_turned_position_has_the_turned_moves(compiled):
    made = compiled.game
    assert len(made.symmetries) == {"othello": 3, "hex": 1, "go_9x9": 7, "go_19x19": 7}.get(made.id, 0)
    if not made.symmetries:
        return
    observe, legal = jax.jit(made.observe), jax.jit(made.legal)
    random = np.random.default_rng(6)
    moves = [action for _, action in random_moves(random, compiled, 40) if action is not None]
    for symmetry in made.symmetries:
        turned_action = np.argsort(symmetry.actions)
        plain = turned = compiled.init(KEY)
        for move in moves:
            np.testing.assert_array_equal(np.asarray(legal(plain))[symmetry.actions], legal(turned))
            plain, turned = compiled.play(plain, move), compiled.play(turned, int(turned_action[move]))
            np.testing.assert_array_equal(symmetry.observation(observe(plain)), observe(turned))


def test_player_0_moves_first_and_a_position_is_small(compiled):
    made = compiled.game
    for seed in range(5):
        position = compiled.init(jax.random.key(seed))
        assert compiled.facts(position)[1] == 0
        # Othello is our own, and has none.
        assert made.id == "othello" or position.observation.size == 0
        assert all(not jnp.asarray(leaf).weak_type for leaf in jax.tree.leaves(position))
    before = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), position)
    after = compiled.play(position, compiled.facts(position)[0][0])
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == before
    assert made.observe(position).shape == made.observation_shape


@pytest.mark.slow
def test_chess_is_python_chess_move_by_move(quick_compile):
    import chess

    compiled = Compiled(game("chess"))
    made, random, ends = compiled.game, np.random.default_rng(7), set()
    for _ in range(4):
        board = chess.Board()
        for position, action in random_moves(random, compiled):
            legal, player, over, rewards = compiled.facts(position)
            drawn = board.is_repetition(3) or board.halfmove_clock >= 100 or board.is_insufficient_material() or board.ply() >= 512
            # pgx tells positions apart by an en-passant square that nobody can use: it may see a repetition later.
            assert over == (drawn or board.is_game_over()) or board.is_repetition(3)
            assert rewards.tolist() == ([0, 0] if not board.is_checkmate() else [-1, 1] if board.turn else [1, -1])
            shown = {str(piece) for row in made.board(position).rows for piece in row}
            assert shown - {""} == {piece.symbol() for piece in board.piece_map().values()}
            ranks = [[str(board.piece_at(chess.square(f, r)) or "") for f in range(8)] for r in range(7, -1, -1)]
            assert [list(row) for row in made.board(position).rows] == ranks
            if action is None:
                ends.add(board.outcome(claim_draw=True).termination if board.outcome(claim_draw=True) else "length")
                break
            assert player == (0 if board.turn else 1)
            assert sorted(made.action_name(position, move) for move in legal) == sorted(move.uci() for move in board.legal_moves)
            board.push_uci(made.action_name(position, action))
    assert ends


def test_the_version_and_its_absence_are_told_in_one_line(monkeypatch):
    monkeypatch.setattr(pgx_games, "version", lambda name: "2.7.1")
    with pytest.raises(UserError, match=r"pgx 2\.7\.1 is installed, but its games are tested with 2\.6: pip install 'pgx==2\.6\.\*'"):
        pgx_games.check_version()

    def missing(name):
        raise pgx_games.PackageNotFoundError(name)

    monkeypatch.setattr(pgx_games, "version", missing)
    with pytest.raises(UserError, match=r"not installed: pip install 'thorndike\[games\]'"):
        pgx_games.check_version()
    monkeypatch.undo()
    pgx_games.check_version()


def test_every_adapted_game_has_a_face_and_a_length():
    assert set(ADAPTED_GAMES) == set(pgx_games.FACES) == set(pgx_games.LONGEST)


@pytest.mark.slow
def test_self_play_begins_games_with_dice_at_their_beginning(quick_compile):
    positions, _ = game_environment(game("backgammon"), 4).init(KEY)
    assert positions._step_count.tolist() == [0] * 4
