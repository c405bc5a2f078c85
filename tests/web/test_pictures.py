"""What the page draws, without a page: texts, labels, shares, the line of win probabilities, colours that can be read."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from thorndike.games.game import Choice, Player
from thorndike.games.registry import game, game_ids
from thorndike.games.seats import computer, person
from thorndike.games.table import Table
from thorndike.web.icons import game_icon
from thorndike.web.looks import LOOKS, look_of
from thorndike.web.picture import picture
from thorndike.web.probability_line import probability_line

CONNECT_FOUR, TIC_TAC_TOE = game("connect_four"), game("tic_tac_toe")
CSS = (Path(__file__).parents[2] / "src/thorndike/web/static/studio.css").read_text()


def table(made=TIC_TAC_TOE, squares=(), seats=None):
    made_table = Table(made, seats or (person("A"), person("B")))
    for square in squares:
        made_table.click(square)
    return made_table


def drawn(made_table):
    return picture(made_table.game, made_table.view())


@pytest.mark.parametrize(
    ("squares", "status", "line"),
    [
        ([], "X to move", ()),
        ([(0, 0)], "O to move", ()),
        ([(0, 0), (1, 0), (0, 1), (1, 1), (0, 2)], "X wins", ((0, 0), (0, 1), (0, 2))),
        ([(0, 2), (0, 0), (1, 1), (0, 1), (2, 0)], "X wins", ((0, 2), (1, 1), (2, 0))),
        ([(1, 1), (0, 0), (0, 2), (2, 0), (1, 0), (1, 2), (0, 1), (2, 1), (2, 2)], "A draw", ()),
    ],
)
def test_the_status_says_whose_turn_it_is_and_who_won(squares, status, line):
    found = drawn(table(squares=squares))
    assert found.status == status and found.board["line"] == line


def test_it_is_said_by_seats_where_one_person_plays():
    foe = Player("Foe", lambda turn: Choice(0))
    mine = table(seats=(person(), computer(foe)))
    assert drawn(mine).status == "Your turn: you are X"
    assert drawn(table(seats=(person(), computer(foe)), squares=[])).board["playable"]


def test_labels_name_square_piece_and_last_move():
    found = drawn(table(CONNECT_FOUR, [(0, 3), (0, 3)]))
    assert found.board["labels"][5][3] == "d1, Red" and found.board["labels"][4][3] == "d2, Yellow, last move"
    assert found.board["labels"][0][0] == "a6, empty" and found.board["last"] == (4, 3)


def test_visits_stand_where_the_pieces_would_fall():
    made = table(CONNECT_FOUR, [(0, 3)])
    made.replay([3], {1: Choice(3, 0.25, {3: 30, 0: 10}, (3, 2))})
    made.show(1)
    assert drawn(made).board["shares"] == [] and drawn(made).analysis == ""
    made.analyse(True)
    found = drawn(made)
    assert found.board["shares"] == [[4, 3, 0.75], [5, 0, 0.25]]
    assert found.analysis == "Yellow wins with 25% · 40 visits, their shares on the board · expected: d c"
    assert found.probabilities == (None, 0.75) and found.chance == "Red 75%"


def test_the_end_of_a_game_is_certain():
    found = drawn(table(squares=[(0, 0), (1, 0), (0, 1), (1, 1), (0, 2)]))
    assert found.probabilities == (None, None, None, None, None, 1.0)


@pytest.mark.parametrize("chances", [(), (None,), (0.5,), (None, 0.25, None, 1.0), tuple(i / 60 for i in range(61))], ids=len)
def test_the_line_is_a_sound_drawing(chances):
    text = probability_line(chances, 1, "<Red>", "Yellow")
    box = ElementTree.fromstring(text)
    points = [float(number) for line in box.iter("polyline") for number in re.split("[ ,]", line.get("points"))]
    assert len(points) == 2 * sum(chance is not None for chance in chances)
    assert all(0 <= number <= 320 for number in points)


def test_every_game_has_a_look_and_every_look_a_picture():
    assert set(game_ids()) <= set(LOOKS)
    for look in [*LOOKS.values(), look_of("my.module:MY_GAME")]:
        ElementTree.fromstring(game_icon(look.pieces))
    assert look_of("my.module:MY_GAME").title == "My game"


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("palette", [0, 1], ids=["light", "dark"])
@pytest.mark.parametrize(
    ("front", "back", "least"),
    [
        ("ink", "ground", 7),
        ("ink", "surface", 7),
        ("quiet", "ground", 4.5),
        ("quiet", "surface", 4.5),
        ("accent", "ground", 4.5),
        ("accent", "surface", 4.5),
        ("on-accent", "accent", 4.5),
        ("wrong", "wrong-ground", 4.5),
        # Of what is no text.
        ("edge", "surface", 3),
        ("edge", "ground", 3),
        ("hole", "well", 3),
        ("second", "well", 3),
    ],
)
def test_colours_can_be_told_apart(palette, front, back, least):
    colours = [dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", block)) for block in re.findall(r":root \{(.*?)\}", CSS, flags=re.DOTALL)]
    bright, dim = sorted((_luminance(colours[palette][name]) for name in (front, back)), reverse=True)
    assert (bright + 0.05) / (dim + 0.05) >= least


def test_nothing_is_named_that_lies_elsewhere():
    for file in (Path(__file__).parents[2] / "src/thorndike/web").rglob("*.*"):
        if file.suffix in (".py", ".js", ".css"):
            assert not re.search(r"https?://(?!\{)", file.read_text()), file
