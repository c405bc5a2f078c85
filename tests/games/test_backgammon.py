"""Backgammon: what a network sees of it, and GNU Backgammon: its names of positions and moves, and itself where it is installed."""

import jax
import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.games.engines import ENGINES, check_engine, engine, program_of
from thorndike.games.game import Turn
from thorndike.games.gnubg import actions_of, hops_of, position_id
from thorndike.games.match import compiled, play_game
from thorndike.games.players import random_player
from thorndike.games.registry import game


@pytest.fixture(scope="module")
def rules():
    pytest.importorskip("pgx")
    return compiled(game("backgammon"))


def begun(rules, first: int, second: int):
    """The first position, with this throw."""
    position = rules.init(0)
    dice = np.array([first - 1, second - 1], np.int32)
    left = np.array([*dice, *(dice if first == second else (-1, -1))], np.int32)
    position = position.replace(_dice=dice, _playable_dice=left)
    mask = np.zeros(156, bool)
    board = np.asarray(position._board)
    for die in {first, second}:
        for index in range(24):
            ends = index + die
            mask[(index + 2) * 6 + die - 1] = board[index] > 0 and ends < 24 and board[ends] >= -1
    return position.replace(legal_action_mask=mask)


def test_a_position_has_the_name_that_gnubg_gives_it(rules):
    board = np.asarray(rules.init(0)._board)
    assert position_id(board) == "4HPwATDgc/ABMA", "the beginning, by gnubg itself"
    # After 8/5 6/5, as the other one sees it, who is on roll: by gnubg's `move 8/5 6/5`, `show board`.
    board = board.copy()
    board[[16, 18, 19]] += [-1, -1, 2]
    turned = np.concatenate([-board[23::-1], -board[[25, 24, 27, 26]]])
    assert position_id(turned) == "sGfwATDgc/ABMA"


@pytest.mark.parametrize(
    ("text", "hops"),
    [
        ("8/5 6/5", [(8, 5), (6, 5)]),
        ("bar/20* 13/7(2)", [(25, 20), (13, 7), (13, 7)]),
        ("24/18/14*", [(24, 18), (18, 14)]),
        ("6/off(3) 2/off", [(6, 0), (6, 0), (6, 0), (2, 0)]),
    ],
)
def test_moves_are_read_as_hops(text, hops):
    assert hops_of(text) == hops


@pytest.mark.parametrize(
    ("throw", "text", "names"),
    [
        ((3, 1), "8/5 6/5", ["8/5", "6/5"]),
        ((6, 5), "24/13", ["24/18", "18/13"]),
        ((5, 6), "24/13", ["24/18", "18/13"]),
        ((6, 6), "24/18(2) 13/7(2)", ["24/18", "24/18", "13/7", "13/7"]),
        ((2, 2), "13/7 6/4", ["13/11", "11/9", "9/7", "6/4"]),
        ((3, 1), "8/4 6/5", None),
        ((5, 1), "24/17", None),
    ],
)
def test_hops_are_played_over_the_dice_of_a_throw_in_an_order_that_is_legal(rules, throw, text, names):
    position = begun(rules, *throw)
    actions = actions_of(rules.game, position, hops_of(text))
    if names is None:
        assert actions is None
        return
    said = []
    for number, action in enumerate(actions):
        assert action in rules.legal(position)
        said.append(rules.game.action_name(position, action))
        position = rules.step(position, action, 0, number)
    assert said == names


def test_a_hop_of_both_dice_is_not_taken_for_one_of_the_larger(rules):
    position = begun(rules, 5, 4)
    board = np.zeros(28, np.int32)
    board[[19, 23, 26, 0, 27]] = 1, 2, 12, -5, -10
    mask = np.zeros(156, bool)
    for die in (4, 5):
        mask[(26 - 5) * 6 + die - 1] = True
    position = position.replace(_board=board, legal_action_mask=mask)
    names, after = [], position
    for number, action in enumerate(actions_of(rules.game, position, [(5, 0)])):
        names.append(rules.game.action_name(after, action))
        after = rules.step(after, action, 0, number)
    assert names == ["5/1", "1/off:5"] and rules.mover(after) != rules.mover(position)


def test_a_network_sees_each_point_as_tesauros_did(rules):
    seen, random = jax.jit(rules.game.observe), np.random.default_rng(3)
    position = rules.init(0)
    for number in range(60):
        board, left = np.asarray(position._board), [int(die) for die in np.asarray(position._playable_dice) if die >= 0]
        expected = []
        for side in (1, -1):
            for index in range(24):
                count = max(side * int(board[index]), 0)
                expected += [float(count == 1), float(count >= 2), float(count >= 3), max(count - 3, 0) / 2]
        expected += [board[24] / 2, -board[25] / 2, board[26] / 15, -board[27] / 15]
        expected += [float(die in left) for die in range(6)] + [len(left) / 4]
        np.testing.assert_allclose(seen(position)[0, 0], expected, atol=1e-6)
        legal = rules.legal(position)
        position = rules.step(position, int(random.choice(legal)), 5, number)


def test_it_is_known_where_it_can_play_and_what_can_be_set():
    for text, game_id, message in [
        ("gnubg", "chess", "plays backgammon"),
        ("gnubg:plies=9", "backgammon", "from 0 to 4"),
        ("gnubg:level=1", "backgammon", "no setting 'level'"),
    ]:
        with pytest.raises(UserError, match=message):
            check_engine(text, game_id)


@pytest.mark.slow
def test_it_plays_whole_games_by_the_rules_and_beats_random_moves(rules):
    try:
        program_of(ENGINES["gnubg"])
    except UserError:
        pytest.skip("GNU Backgammon is not installed")
    player = engine("gnubg", "backgammon")
    try:
        played = [play_game(rules, order, i, (), i) for i, order in enumerate([(player, random_player(1)), (random_player(2), player)])]
    finally:
        player.close()
    assert [game.remark for game in played] == ["", ""], "no forfeit: every hint was a legal move of the position it was asked about"
    assert [game.score for game in played] == [1.0, 0.0]


@pytest.mark.slow
def test_a_throw_that_somebody_else_began_is_refused_in_one_line(rules):
    try:
        program_of(ENGINES["gnubg"])
    except UserError:
        pytest.skip("GNU Backgammon is not installed")
    position = begun(rules, 3, 1)
    position = rules.step(position, actions_of(rules.game, position, [(8, 5), (6, 5)])[0], 0, 0)
    player = engine("gnubg", "backgammon")
    try:
        with pytest.raises(UserError, match="at the next throw"):
            player.choose(Turn(rules.game, position, (1,)))
    finally:
        player.close()
