"""A game on a table, without a browser: moves, refusals, thinking in threads, taking back, replaying, files."""

import threading
import time

import numpy as np
import pytest

from thorndike.errors import UserError
from thorndike.games.game import Choice, Player, Stopped, Turn
from thorndike.games.plies import line_names, target_square
from thorndike.games.registry import game
from thorndike.games.saved_game import read_saved_game, saved_actions, saved_game_file
from thorndike.games.seats import computer, person
from thorndike.games.table import Outcome, Table

TIC_TAC_TOE, CONNECT_FOUR = game("tic_tac_toe"), game("connect_four")


def lowest(turn: Turn) -> Choice:
    legal = np.flatnonzero(np.asarray(turn.game.legal(turn.position)))
    return Choice(int(legal[0]), 0.75, {int(action): 10 + int(action) for action in legal}, (int(legal[0]),))


def held(gate: threading.Event, closed: threading.Event | None = None, asked: threading.Event | None = None) -> Player:
    """The first legal move, but not before the gate opens."""

    def choose(turn: Turn) -> Choice:
        if asked is not None:
            asked.set()
        assert gate.wait(20)
        return lowest(turn)

    return Player("Held", choose, closed.set if closed else lambda: None)


class Endless:
    """Thinks until it is told to stop."""

    def __init__(self):
        self.asked, self.ended, self.count = threading.Event(), threading.Event(), 0
        self.player = Player("Endless", self.choose)

    def choose(self, turn: Turn) -> Choice:
        self.count += 1
        self.ended.clear()
        self.asked.set()
        ends = time.monotonic() + 20
        while not turn.stopped():
            assert time.monotonic() < ends
            time.sleep(0.001)
        self.ended.set()
        raise Stopped

    def begins(self) -> bool:
        begun = self.asked.wait(20)
        self.asked.clear()
        return begun


def until(condition, seconds: float = 20.0) -> None:
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends, "it did not happen in time"
        time.sleep(0.005)


def persons(game=TIC_TAC_TOE) -> Table:
    return Table(game, (person("A"), person("B")))


def played(table: Table, *squares: tuple[int, int]) -> Table:
    for square in squares:
        table.click(square)
    return table


def test_a_whole_game_between_persons_is_won():
    table = played(persons(), (0, 0), (1, 0), (0, 1), (1, 1), (0, 2))
    view = table.view()
    assert view.outcome == Outcome(0)
    assert view.names == ("a3", "a2", "b3", "b2", "c3")
    assert view.ply.board.rows[0] == ("X", "X", "X")
    with pytest.raises(UserError, match="the game is over"):
        table.click((2, 2))


@pytest.mark.parametrize(
    ("square", "why"), [((0, 0), "a3 is taken"), ((7, 0), "there is no square"), ((0, -1), "there is no square")], ids=str
)
def test_an_illegal_click_says_why_and_changes_nothing(square, why):
    table = played(persons(), (0, 0))
    before, told = table.view(), []
    table.listen(lambda: told.append(1))
    with pytest.raises(UserError, match=why):
        table.click(square)
    assert table.view() == before and not told


def test_a_piece_falls_and_its_square_is_the_one_it_falls_on():
    table = played(persons(CONNECT_FOUR), (0, 3), (2, 3))
    assert [table.view().plies[-1].board.rows[row][3] for row in (5, 4, 3)] == ["X", "O", ""]
    first, third = table.view().plies[0], table.view().plies[2]
    assert target_square(CONNECT_FOUR, third, 3) == (3, 3) and target_square(CONNECT_FOUR, first, 3) == (5, 3)
    assert target_square(CONNECT_FOUR, third, 0) == (5, 0)
    assert line_names(CONNECT_FOUR, third, [3, 0, 3, 9, 1], 8) == ("d", "a", "d")


def test_a_full_column_is_refused():
    table = persons(CONNECT_FOUR)
    for _ in range(6):
        table.click((0, 2))
    with pytest.raises(UserError, match="c6 is taken"):
        table.click((0, 2))


def test_the_computer_answers_and_says_what_it_thought():
    table = Table(TIC_TAC_TOE, (person(), computer(Player("First", lowest))))
    table.click((1, 1))
    until(lambda: len(table.view().moves) == 2)
    view = table.view()
    assert view.moves == (4, 0) and view.thinking is None and view.shown == 2
    assert view.choices[1].win_probability == 0.75 and view.choices[1].visits[0] == 10


def test_whoever_waits_may_not_play_and_may_interrupt():
    gate = threading.Event()
    table = Table(TIC_TAC_TOE, (person(), computer(held(gate))))
    table.click((1, 1))
    assert table.view().thinking == "Held"
    with pytest.raises(UserError, match="not your turn: Held is thinking"):
        table.click((0, 0))
    table.interrupt()
    assert table.view().thinking is None and table.view().paused
    gate.set()
    with pytest.raises(UserError, match="let it go on"):
        table.click((0, 0))
    time.sleep(0.1)
    assert table.view().moves == (4,), "the answer of an interrupted search is thrown away"
    table.go_on()
    until(lambda: len(table.view().moves) == 2)
    with pytest.raises(UserError, match="nobody is thinking"):
        table.interrupt()


def test_taking_back_returns_to_the_persons_turn():
    table = Table(TIC_TAC_TOE, (person(), computer(Player("First", lowest))))
    table.click((1, 1))
    until(lambda: len(table.view().moves) == 2)
    table.take_back()
    view = table.view()
    assert view.moves == () and not view.choices.keys() - {0} and not view.paused
    with pytest.raises(UserError, match="no move was played"):
        table.take_back()


def test_taking_back_the_computers_first_move_does_not_make_it_play_again():
    table = Table(TIC_TAC_TOE, (computer(Player("First", lowest)), person()))
    table.begin()
    until(lambda: len(table.view().moves) == 1)
    table.take_back()
    time.sleep(0.05)
    assert table.view().moves == () and table.view().paused


def test_taking_back_while_the_computer_thinks_takes_the_persons_move():
    gate = threading.Event()
    table = Table(TIC_TAC_TOE, (person(), computer(held(gate))))
    table.click((1, 1))
    table.take_back()
    gate.set()
    table.click((0, 2))
    until(lambda: len(table.view().moves) == 2)
    assert table.view().moves == (2, 0), "the old search does not answer in the new game"


def test_swapping_sides_lets_the_computer_play_the_other_side():
    table = Table(TIC_TAC_TOE, (person(), computer(Player("First", lowest))))
    table.swap_sides()
    until(lambda: len(table.view().moves) == 1)
    assert table.view().seats[0].name == "First"
    table.click((1, 1))
    until(lambda: len(table.view().moves) == 3)


def test_looking_back_changes_nothing_and_playing_there_is_refused():
    table = played(persons(), (0, 0), (1, 1), (2, 2))
    table.show(1)
    assert table.view().ply.board.rows[1][1] == "" and not table.view().at_end
    with pytest.raises(UserError, match="the position after move 1 of 3"):
        table.click((0, 1))
    table.show(99)
    assert table.view().at_end and len(table.view().moves) == 3


def test_playing_on_from_an_earlier_position_leaves_out_what_came_after():
    table = played(persons(), (0, 0), (1, 0), (0, 1), (1, 1), (0, 2))
    table.show(3)
    table.play_on_from_here()
    assert table.view().moves == (0, 3, 1) and table.view().at_end and table.view().outcome is None
    table.click((0, 2))
    assert table.view().names[-1] == "c3"


def test_the_analyst_searches_the_position_looked_at():
    table = Table(TIC_TAC_TOE, (person("A"), person("B")), analyst=computer(Player("First", lowest)))
    table.analyse(True)
    until(lambda: 0 in table.view().choices)
    played(table, (0, 0))
    until(lambda: 1 in table.view().choices)
    assert table.view().moves == (0,), "an analyst does not play"
    assert not table.view().analysing


def test_a_player_that_cannot_go_on_is_reported_and_waits():
    def broken(turn: Turn) -> Choice:
        raise UserError("the engine\nhas gone")

    table = Table(TIC_TAC_TOE, (person(), computer(Player("Engine", broken))))
    table.click((0, 0))
    until(lambda: table.view().paused)
    assert table.view().notice == "Engine cannot go on: the engine has gone" and table.view().moves == (0,)


def test_an_illegal_answer_is_not_played():
    table = Table(TIC_TAC_TOE, (person(), computer(Player("Liar", lambda turn: Choice(0)))))
    table.click((0, 0))
    until(lambda: table.view().paused)
    assert "not legal" in table.view().notice and table.view().moves == (0,)


def test_resigning_ends_the_game():
    table = Table(TIC_TAC_TOE, (person(), computer(Player("Polite", lambda turn: Choice(0, resigns=True)))))
    table.click((0, 0))
    until(lambda: table.view().outcome is not None)
    assert table.view().outcome == Outcome(0, resigned=True)
    table.take_back()
    assert table.view().outcome is None and table.view().moves == ()


def test_who_leaves_the_table_is_closed_after_thinking():
    gate, closed, asked = threading.Event(), threading.Event(), threading.Event()
    table = Table(TIC_TAC_TOE, (computer(held(gate, closed, asked)), person()))
    table.begin()
    assert asked.wait(20)
    table.seat((person("A"), person("B")))
    assert not closed.wait(0.05)
    gate.set()
    assert closed.wait(20)
    assert table.view().moves == () and table.view().thinking is None


def test_a_saved_game_is_read_and_replayed():
    table = Table(CONNECT_FOUR, (person(), computer(Player("First", lowest))))
    table.click((0, 3))
    until(lambda: len(table.view().moves) == 2)
    view = table.view()
    data = saved_game_file(CONNECT_FOUR, table.seed, [seat.name for seat in view.seats], view.names, view.choices)
    saved = read_saved_game(data, "the file")
    assert (saved.game, saved.players, saved.moves) == ("connect_four", ("You", "First"), ("d", "a"))
    other = persons(CONNECT_FOUR)
    other.replay(*saved_actions(CONNECT_FOUR, saved))
    assert other.view().moves == view.moves and other.view().shown == 0
    assert other.view().choices[1].win_probability == 0.75
    other.show(2)
    assert other.view().ply.board == view.ply.board


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        (b'"d"', b'"h"', "move 1 of the saved game, h, is not legal"),
        (b"thorndike-game", b"something", "is no saved game"),
        (b'"seed": 0', b'"seed": -1', "'seed' is -1"),
        (b"0.75", b"7.5", "'win_probabilities' is"),
        (b"0.75", b"NaN", "'win_probabilities' is"),
        (b"{", b"[", "is damaged"),
        (b'"moves"', b'"x"', "it has no 'moves'"),
    ],
    ids=str,
)
def test_a_damaged_file_is_one_line(old, new, why):
    data = saved_game_file(CONNECT_FOUR, 0, ["A", "B"], ["d", "a"], {1: Choice(0, 0.75)}).replace(old, new)
    with pytest.raises(UserError, match=why) as raised:
        saved_actions(CONNECT_FOUR, read_saved_game(data, "the file"))
    assert "\n" not in str(raised.value)


def test_too_long_a_file_is_refused():
    with pytest.raises(UserError, match="too long"):
        read_saved_game(b" " * 300_000, "the file")
    many = saved_game_file(TIC_TAC_TOE, 0, ["A", "B"], ["a1"] * 12, {})
    with pytest.raises(UserError, match="12 moves are more than a game of tic_tac_toe can have"):
        saved_actions(TIC_TAC_TOE, read_saved_game(many, "the file"))


def test_a_move_of_two_clicks():
    """Nim-like toy of two clicks made from tic-tac-toe: choose the middle first, then where to place."""
    base = TIC_TAC_TOE

    def board(position):
        plain = base.board(position)
        return plain._replace(clicks={((1, 1), squares[0]): action for squares, action in plain.clicks.items() if action != 4})

    table = Table(base._replace(board=board), (person("A"), person("B")))
    with pytest.raises(UserError, match="a3 is empty: choose a piece first"):
        table.click((0, 0))
    table.click((1, 1))
    assert table.view().pending == ((1, 1),) and table.view().moves == ()
    table.click((1, 1))
    assert table.view().pending == (), "a second click lets go"
    played(table, (1, 1), (0, 0), (1, 1))
    with pytest.raises(UserError, match="b2 cannot go to a3"):
        table.click((0, 0))
    assert table.view().moves == (0,) and table.view().pending == ((1, 1),)


@pytest.mark.parametrize(
    "end",
    [
        lambda table: table.interrupt(),
        lambda table: table.take_back(),
        lambda table: table.restart(),
        lambda table: table.seat((person("A"), person("B"))),
        lambda table: table.close(),
    ],
    ids=["stop", "take back", "new game", "another opponent", "end of the studio"],
)
def test_whoever_is_not_waited_for_any_more_is_told_to_stop(end):
    thinker = Endless()
    table = Table(TIC_TAC_TOE, (person(), computer(thinker.player)))
    table.click((1, 1))
    assert thinker.begins()
    end(table)
    assert thinker.ended.wait(20)
    assert table.view().thinking is None and not table.view().notice


def test_nobody_thinks_while_nobody_looks():
    thinker = Endless()
    table = Table(TIC_TAC_TOE, (person(), computer(thinker.player)))
    first, second = table.listen(lambda: None), table.listen(lambda: None)
    table.click((1, 1))
    assert thinker.begins()
    first()
    first()
    time.sleep(0.05)
    assert not thinker.ended.is_set(), "the other page is still open"
    second()
    assert thinker.ended.wait(20)
    assert table.view().thinking is None and not table.view().paused
    again = table.listen(lambda: None)
    assert thinker.begins() and table.view().thinking == "Endless"
    again()
    assert thinker.ended.wait(20) and thinker.count == 2
