"""The board in a real browser: whole games by clicks and by keys, and what goes wrong on the way."""

import json
import re

import pytest

pytest.importorskip("nicegui")
from playwright.sync_api import Page, expect

# The machine may be busy with other tests.
expect.set_options(timeout=60_000)


def start(page: Page, studio, game="tic_tac_toe", opponent=None, strength=None, begins=None) -> Page:
    page.goto(f"{studio.root}/new/{game}")
    for label, value in (("Opponent", opponent), ("Strength", strength), ("Who begins", begins)):
        if value is not None:
            page.get_by_label(label).select_option(value)
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/play/*")
    return page


def square(page: Page, row: int, column: int):
    return page.locator(f'[data-square="{row},{column}"]')


def status(page: Page):
    return page.locator(".status-line")


def moves(page: Page):
    return page.locator(".moves button")


def tab_to(page: Page, selector: str) -> None:
    """Press Tab until what is looked for has the focus."""
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("selector => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab does not reach {selector}")


def test_a_game_of_tic_tac_toe_by_clicks(page, studio):
    start(page, studio, opponent="first")
    expect(status(page)).to_have_text("Your turn: you are X")
    shown = [each for each in page.get_by_role("group", name="Game", exact=True).get_by_role("button").all_inner_texts() if each]
    assert shown == ["Take back", "Swap sides", "New game", "Save"]
    # The opponent takes a3, then b3, and is too late.
    for number, (row, column) in enumerate(((1, 1), (0, 2), (2, 0))):
        square(page, row, column).click()
        expect(moves(page)).to_have_count(min(2 * number + 2, 5))
    expect(status(page)).to_have_text("You win")
    expect(moves(page)).to_have_text(["b2", "a3", "c3", "b3", "a1"])
    expect(page.locator(".square.line")).to_have_count(3)
    square(page, 2, 2).click()
    expect(page.get_by_role("alert")).to_have_text("the game is over: take a move back, or begin a new one")


def test_a_game_of_connect_four_by_clicks(page, studio):
    start(page, studio, "connect_four", opponent="first", begins="opponent")
    expect(moves(page)).to_have_count(1)
    for number, column in enumerate((3, 4, 5)):
        # Any square of a column drops the piece into it.
        square(page, number, column).click()
        expect(moves(page)).to_have_count(2 * number + 3)
    # The opponent's fourth in the first column came before.
    expect(status(page)).to_have_text("First wins")
    expect(page.locator(".square.line .piece.first")).to_have_count(4)
    expect(square(page, 5, 3)).to_have_attribute("aria-label", "d1, Yellow")
    expect(square(page, 2, 0)).to_have_attribute("aria-label", "a4, Red, last move")


def test_a_game_by_keyboard_alone(page, studio):
    page.goto(studio.root)
    page.wait_for_selector(".card")
    tab_to(page, 'a[href="/new/tic_tac_toe"]')
    page.keyboard.press("Enter")
    page.wait_for_selector("select")
    tab_to(page, "select")
    page.keyboard.type("First")
    tab_to(page, "button.primary")
    page.keyboard.press("Enter")
    page.wait_for_selector(".board")
    tab_to(page, ".square")
    outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle + getComputedStyle(document.activeElement).outlineWidth")
    assert outline == "solid3px", "where the focus is can be seen"
    # The middle is reached first: c3, then a1.
    for number, keys in enumerate(
        (["Enter"], ["ArrowUp", "ArrowRight", "ArrowRight", "Enter"], ["ArrowDown", "ArrowDown", "Home", "Space"])
    ):
        for key in keys:
            page.keyboard.press(key)
        expect(moves(page)).to_have_count(min(2 * number + 2, 5))
    expect(status(page)).to_have_text("You win")
    tab_to(page, ".slider")
    page.keyboard.press("ArrowLeft")
    expect(status(page)).to_have_text("Position after move 4 of 5")
    page.keyboard.press("Home")
    expect(page.locator(".piece")).to_have_count(0)


def test_an_illegal_click_says_why_and_changes_nothing(page, studio):
    start(page, studio, opponent="first")
    square(page, 0, 0).click()
    expect(moves(page)).to_have_count(2)
    labels = page.locator(".square").evaluate_all("squares => squares.map(each => each.ariaLabel)")
    square(page, 0, 0).click()
    expect(page.get_by_role("alert")).to_have_text("a3 is taken")
    assert page.locator(".square").evaluate_all("squares => squares.map(each => each.ariaLabel)") == labels
    expect(moves(page)).to_have_count(2)
    square(page, 2, 2).click()
    expect(page.get_by_role("alert")).to_be_empty()


def test_events_that_no_page_of_ours_sends_do_nothing(page, studio):
    start(page, studio, opponent="first")
    square(page, 0, 0).click()
    expect(moves(page)).to_have_count(2)
    board = "Object.values(mounted_app.elements).find(each => each.props.rows)"
    page.evaluate(
        f"""() => {{
            const id = Number(Object.keys(mounted_app.elements).find((key) => mounted_app.elements[key] === {board}));
            const event = mounted_app.elements[id].events.find(each => each.type === "square");
            const emit = (args) =>
                window.socket.emit("event", {{ id, client_id: window.clientId, listener_id: event.listener_id, args }});
            const told = ["x", [1], [1, "1"], [99, 0], [-1, 0], null, {{}}, [0.5, 1]];
            told.forEach((value) => emit([JSON.stringify(value)]));
        }}"""
    )
    expect(page.get_by_role("alert")).to_have_text(re.compile("there is no square"))
    square(page, 2, 2).click()
    expect(moves(page)).to_have_count(4)


def test_reloading_in_the_middle_goes_on(page, studio):
    start(page, studio, "connect_four", opponent="lookahead")
    square(page, 0, 0).click()
    expect(moves(page)).to_have_text(["a", "d"])
    page.reload()
    expect(moves(page)).to_have_text(["a", "d"])
    square(page, 0, 0).click()
    expect(moves(page)).to_have_text(["a", "d", "a", "d"])


def test_a_dropped_connection_comes_back_to_the_same_game(page, context, studio):
    start(page, studio, opponent="person")
    square(page, 0, 0).click()
    expect(moves(page)).to_have_count(1)
    other = context.new_page()
    other.goto(page.url)
    expect(moves(other)).to_have_count(1)
    page.evaluate("window.kept = true; window.socket.io.engine.close()")
    square(other, 1, 1).click()
    expect(moves(page)).to_have_count(2)
    square(page, 2, 2).click()
    expect(moves(other)).to_have_count(3)
    assert page.evaluate("window.kept"), "the page went on without being loaded anew"


def test_two_tabs_of_a_game_stay_in_step_and_those_of_two_games_apart(page, context, studio):
    start(page, studio, opponent="person")
    same, apart = context.new_page(), context.new_page()
    same.goto(page.url)
    start(apart, studio, opponent="person")
    square(page, 0, 0).click()
    expect(square(same, 0, 0)).to_have_attribute("aria-label", "a3, X, last move")
    square(same, 1, 1).click()
    expect(moves(page)).to_have_text(["a3", "b2"])
    expect(square(apart, 0, 0)).to_have_attribute("aria-label", "a3, empty")
    expect(moves(apart)).to_have_count(0)


def test_the_page_is_free_while_the_opponent_thinks_and_can_stop_it(page, studio):
    start(page, studio, opponent="slow", strength="800")
    square(page, 0, 0).click()
    expect(status(page)).to_have_text("Slow is thinking")
    square(page, 1, 1).click()
    expect(page.get_by_role("alert")).to_have_text("it is not your turn: Slow is thinking")
    page.get_by_role("button", name="Stop thinking").click()
    expect(status(page)).to_have_text("Slow (O) waits")
    page.get_by_role("button", name="Take back").click()
    expect(status(page)).to_have_text("Your turn: you are X")
    expect(moves(page)).to_have_count(0)


def test_taking_back_swapping_sides_and_beginning_anew(page, studio):
    start(page, studio, opponent="first")
    square(page, 1, 1).click()
    expect(moves(page)).to_have_count(2)
    page.get_by_role("button", name="Take back").click()
    expect(moves(page)).to_have_count(0)
    page.get_by_role("button", name="Swap sides").click()
    expect(moves(page)).to_have_text(["a3"])
    expect(status(page)).to_have_text("Your turn: you are O")
    asked = []
    page.once("dialog", lambda dialog: (asked.append(dialog.message), dialog.dismiss()))
    page.get_by_role("button", name="New game").click()
    expect(moves(page)).to_have_count(1)
    assert asked == ["Begin a new game? The moves of this one are lost."]
    square(page, 1, 1).click()
    expect(moves(page)).to_have_count(3)
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="New game").click()
    expect(moves(page)).to_have_count(1)


def test_what_the_search_thinks_is_drawn(page, studio):
    start(page, studio, "connect_four", opponent="lookahead", strength="800")
    expect(page.locator(".share")).to_have_count(0)
    page.get_by_label("Show what the search thinks").check()
    expect(page.locator(".share")).to_have_count(7)
    expect(square(page, 5, 3)).to_have_attribute("aria-label", re.compile(r"d1, empty, \d+% of the search"))
    expect(page.locator(".analysis")).to_have_text(re.compile(r"Red wins with \d+% · [78]\d\d visits.* expected: d"))
    square(page, 0, 3).click()
    expect(moves(page)).to_have_count(2)
    expect(square(page, 3, 3).locator(".share")).to_have_count(1)
    expect(page.locator("svg.chances")).to_have_attribute("aria-label", re.compile(r"Win probability of Red: now \d+%"))
    assert len(page.locator("svg.chances .line").get_attribute("points").split()) == 3


def test_a_game_is_saved_and_replayed(page, studio, tmp_path):
    start(page, studio, "connect_four", opponent="first")
    for column in (3, 4):
        square(page, 0, column).click()
        expect(moves(page)).to_have_count(2 * (column - 2))
    with page.expect_download() as told:
        page.get_by_role("button", name="Save").click()
    file = tmp_path / told.value.suggested_filename
    told.value.save_as(file)
    assert file.name == "connect_four-4-moves.json"
    assert json.loads(file.read_text())["moves"] == ["d", "a", "e", "a"]
    page.goto(studio.root)
    page.locator("input[type=file]").set_input_files(file)
    page.wait_for_url("**/play/*")
    expect(status(page)).to_have_text("The beginning, of 4 moves")
    page.locator(".slider").press("ArrowRight")
    page.locator(".slider").press("ArrowRight")
    expect(status(page)).to_have_text("Position after move 2 of 4")
    expect(page.locator(".piece.first, .piece.second")).to_have_count(2)
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Play on from here").click()
    expect(moves(page)).to_have_text(["d", "a"])
    square(page, 0, 6).click()
    expect(moves(page)).to_have_text(["d", "a", "g"])
    file.write_text(file.read_text().replace('"e"', '"z"'))
    page.goto(studio.root)
    page.locator("input[type=file]").set_input_files(file)
    expect(page.get_by_role("alert")).to_have_text("move 3 of the saved game, z, is not legal there")


def test_an_opponent_that_breaks_is_told_and_another_sits_down(page, studio):
    start(page, studio, opponent="broken")
    square(page, 0, 0).click()
    expect(page.locator(".hint")).to_have_text("Broken cannot go on: the engine has gone")
    page.get_by_text("Change the opponent").click()
    page.get_by_label("Opponent").select_option("first")
    page.get_by_role("button", name="Change, and play on").click()
    expect(moves(page)).to_have_text(["a3", "b3"])


def test_a_game_outlives_its_opponents_place_in_the_list(page, studio):
    start(page, studio, opponent="leaving")
    page.reload()
    expect(status(page)).to_have_text("Your turn: you are X")
    page.get_by_text("Change the opponent").click()
    expect(page.get_by_label("Opponent")).to_have_value("leaving")
    square(page, 1, 1).click()
    expect(moves(page)).to_have_count(2)


def test_a_fault_is_told_and_another_can_be_chosen(page, studio):
    page.goto(f"{studio.root}/new/tic_tac_toe")
    page.get_by_label("Opponent").select_option("faulty")
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("alert")).to_contain_text("a fault of Thorndike's or of the game's (ValueError)")
    page.get_by_label("Opponent").select_option("first")
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/play/*")


def test_what_is_being_chosen_survives_a_move_and_follows_swapped_sides(page, studio):
    start(page, studio, opponent="first")
    page.get_by_text("Change the opponent").click()
    page.get_by_label("Strength").scroll_into_view_if_needed()
    page.get_by_label("Opponent").select_option("lookahead")
    expect(page.get_by_label("Strength")).to_be_enabled()
    square(page, 1, 1).click()
    expect(moves(page)).to_have_count(2)
    expect(page.get_by_label("Opponent")).to_have_value("lookahead")
    page.get_by_role("button", name="Swap sides").click()
    expect(moves(page)).to_have_count(3)
    expect(page.get_by_label("Who begins")).to_have_value("opponent")
    expect(page.get_by_label("Opponent")).to_have_value("first")


def test_a_small_screen_needs_no_scrolling_sideways(page, studio):
    page.set_viewport_size({"width": 360, "height": 700})
    start(page, studio, "connect_four", opponent="lookahead")
    page.wait_for_selector(".board")
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert square(page, 0, 0).bounding_box()["width"] >= 40
    small = page.locator("button:visible, select:visible").evaluate_all("all => all.filter(each => each.offsetHeight < 24).length")
    assert small == 0


def test_a_page_that_is_not_there_says_so(page, studio):
    page.goto(f"{studio.root}/play/nothing")
    expect(page.locator("h1")).to_have_text("This game is no longer on the table")
    page.goto(f"{studio.root}/new/nothing")
    expect(page.locator("h1")).to_have_text("There is no such game")


def test_without_the_token_a_browser_sees_one_line(browser, studio):
    stranger = browser.new_context()
    page = stranger.new_page()
    answer = page.goto(studio.root)
    assert answer.status == 403
    assert page.locator("body").inner_text().startswith("403: open the address that")
    stranger.close()
