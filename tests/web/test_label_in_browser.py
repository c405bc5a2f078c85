"""The labelling page in a real browser: judged by keyboard alone, by several at once, with interruptions; nothing lost, nothing doubled."""

import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from thorndike.language.preferences.formats import export_rows
from thorndike.language.preferences.judgements import Candidate, NewItem
from thorndike.language.preferences.records import check_records
from thorndike.language.preferences.store import Store

TOKEN, KEY = "a-token-of-the-tests", "a-key-of-the-tests"
GUIDELINES = "Prefer what is true, then what is clear."


class Labelled:
    """A store, and a server of it that can be killed and started again on the same port."""

    def __init__(self, folder: Path) -> None:
        self.where = folder / "prefs.db"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.root = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen[str] | None = None

    def fill(self, items):
        with Store(self.where) as store:
            project = store.project("answers", GUIDELINES)
            store.add_items(project, items)

    def start(self) -> None:
        words = [sys.executable, str(Path(__file__).with_name("served_label.py")), str(self.where), str(self.port), TOKEN, KEY]
        self.process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None and self.process.stdout.readline().startswith(self.root)

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait(10)

    def judged(self):
        with Store(self.where) as store:
            return store.judged(store.project("answers"))


@pytest.fixture
def labelled(tmp_path):
    served = Labelled(tmp_path)
    yield served
    if served.process is not None:
        served.process.kill()
        served.process.wait(10)


@pytest.fixture
def sign_in(browser, labelled):
    """Opens the page as a rater in a browser of their own; what each page asked for, and its errors, are looked at in the end."""
    opened, asked, errors = [], [], []

    def open_page(name, **options):
        context = browser.new_context(viewport={"width": 1200, "height": 850}, **options)
        context.set_default_timeout(60_000)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"{labelled.root}/label?token={TOKEN}")
        page.fill("#name", name)
        page.keyboard.press("Enter")
        page.wait_for_selector("#guidelines[open]")
        page.keyboard.press("Escape")
        page.wait_for_selector("#work:not([hidden])")
        opened.append(context)
        return page

    yield open_page
    for context in opened:
        context.close()
    assert asked and all(url.startswith((f"{labelled.root}/", "data:")) for url in asked)
    assert not errors


def answers(number, **more):
    texts = [f"A good answer to {number}.", f"A bad\tanswer  to {number}.\n"]
    return NewItem(
        {"text": f"Question {number}?"}, [Candidate({"text": text}, f"secret-model-{each}") for each, text in enumerate(texts)], **more
    )


def press(page, key):
    """A key, and the page has gone on to another item."""
    before = page.wait_for_function("document.body.dataset.assignment").json_value()
    page.keyboard.press(key)
    page.wait_for_function("before => document.body.dataset.assignment !== before", arg=before)


def prefer_good(page):
    page.wait_for_function("document.body.dataset.assignment")
    first = page.locator(".candidate .content").first.text_content()
    press(page, "1" if first.startswith("A good") else "ArrowRight")


def all_saved(page):
    page.wait_for_function("document.getElementById('saved').textContent === 'All saved'", timeout=60_000)


def interrupted(labelled, sign_in, raters, each):
    """Raters in turns, with an undo each, a reload, and the server killed and started again while they go on."""
    pages = [sign_in(f"rater {number}") for number in range(raters)]
    for turn in range(each):
        if turn == each // 2:
            labelled.kill()
        for number, page in enumerate(pages):
            prefer_good(page)
            if turn == 2:
                # Takes back what was just said, and says it again.
                before = page.evaluate("document.body.dataset.assignment")
                all_saved(page)
                page.keyboard.press("u")
                page.wait_for_function("before => document.body.dataset.assignment !== before", arg=before)
                prefer_good(page)
            if turn == 4 and number % 2:
                page.reload()
                page.wait_for_selector("#work:not([hidden])")
        if turn == each // 2 + 1:
            pages[0].wait_for_function("document.getElementById('saved').textContent.includes('2 kept here')")
            labelled.start()
    for page in pages:
        all_saved(page)
    judged = labelled.judged()
    assert len(judged) == raters * each
    counts = Counter((one.item, one.rater, one.repeated) for one in judged)
    assert set(counts.values()) == {1} and set(Counter(one.rater for one in judged).values()) == {each}
    assert {one.ranks for one in judged} == {(0, 1)}
    return judged


def test_two_raters_by_keyboard_with_undo_reload_and_a_killed_server(labelled, sign_in):
    labelled.fill([answers(number, raters=2) for number in range(40)])
    labelled.start()
    judged = interrupted(labelled, sign_in, raters=2, each=12)
    assert all(one.milliseconds is not None for one in judged)


@pytest.mark.slow
def test_four_raters_make_200_judgements_and_the_export_is_trl_data(labelled, sign_in):
    labelled.fill([answers(number, raters=2) for number in range(150)] + [answers(1_000 + number, best=0) for number in range(10)])
    labelled.start()
    judged = interrupted(labelled, sign_in, raters=4, each=50)
    first = sum(one.shown[0] == 0 for one in judged) / len(judged)
    assert 0.35 < first < 0.65
    with Store(labelled.where) as store:
        rows = export_rows(store, store.project("answers"))
    records = check_records(rows, "the export")
    assert (records.format, records.conversational) == ("preference", False)
    assert all(str(row["chosen"]).startswith("A good") and str(row["rejected"]).startswith("A bad") for row in rows)


def test_what_the_page_says_and_hides(labelled, sign_in):
    labelled.fill([answers(number) for number in range(30)])
    labelled.start()
    page = sign_in("anna")
    assert page.locator("#prompt").text_content().startswith("Question")
    assert "secret" not in page.content() and "secret" not in str(page.evaluate("fetch('/label/next', {method: 'POST', headers: "
        "{'content-type': 'application/json'}, body: JSON.stringify({rater: 'anna'})}).then((answer) => answer.text())"))  # fmt: skip
    # Focus is on the item, and what was said is spoken.
    assert page.evaluate("document.activeElement.id") == "question"
    press(page, "3")
    assert page.locator("#spoken").text_content() == "Tie. Next item."
    press(page, "b")
    press(page, "s")
    # Spaces can be seen.
    page.keyboard.press("w")
    assert page.locator("#whitespace").get_attribute("aria-pressed") == "true"
    assert "→" in "".join(page.locator(".candidate .content").all_text_contents())
    page.keyboard.press("g")
    assert GUIDELINES in page.locator("#guidelines[open]").inner_text()
    page.keyboard.press("1")
    page.keyboard.press("Escape")
    # Every button can be reached and pressed without the mouse.
    page.locator("#details summary").focus()
    page.keyboard.press("Enter")
    page.locator('input[name="strength"]').nth(1).focus()
    page.keyboard.press("Space")
    page.fill("#reason", "because 1 and 2 u")
    page.get_by_role("button", name="A is better").focus()
    press(page, "Enter")
    all_saved(page)
    said = labelled.judged()
    assert [one.verdict for one in said] == ["tie", "both_bad", "skip", "a"]
    assert (said[-1].strength, said[-1].reason) == (2, "because 1 and 2 u")
    # The keys that are held down count once.
    page.evaluate("document.dispatchEvent(new KeyboardEvent('keydown', {key: '1', repeat: true, bubbles: true}))")
    assert "4" in page.locator("#counts").text_content()


def test_the_next_item_is_there_within_100_ms(labelled, sign_in):
    labelled.fill([answers(number) for number in range(40)])
    labelled.start()
    page = sign_in("anna")
    times = page.evaluate(
        """async () => {
            const times = [];
            for (let number = 0; number < 20; number += 1) {
                const before = document.body.dataset.assignment, began = performance.now();
                document.querySelector('main').dispatchEvent(new KeyboardEvent('keydown', {key: '1', bubbles: true}));
                while (document.body.dataset.assignment === before || document.getElementById('work').hidden) {
                    await new Promise((resolve) => setTimeout(resolve, 1));
                    if (performance.now() - began > 5000) return ['too slow'];
                }
                times.push(performance.now() - began);
                await new Promise((resolve) => setTimeout(resolve, 150));
            }
            return times.sort((one, other) => one - other);
        }"""
    )
    assert len(times) == 20 and times[9] < 100


def test_a_ranking_by_digits_and_by_dragging(labelled, sign_in):
    labelled.fill([NewItem({"text": f"Q{each}"}, [Candidate({"text": f"quality {place}"}) for place in range(4)]) for each in range(3)])
    labelled.start()
    page = sign_in("anna")

    def places():
        """Which digit shows which quality."""
        return {text.split()[-1]: place + 1 for place, text in enumerate(page.locator(".candidate .content").all_text_contents())}

    shown = places()
    for key in (shown["0"], shown["1"], "=", shown["2"]):
        page.keyboard.press(str(key))
    press(page, "Enter")
    shown = places()
    page.keyboard.press("Enter")
    assert "4 of 4 have no place yet" in page.locator("#notice").text_content()
    # Dragging the last before the first: the others keep their order.
    page.locator(".candidate").last.drag_to(page.locator(".candidate").first)
    order = [text.split()[-1] for text in page.locator(".candidate .content").all_text_contents()]
    press(page, "Enter")
    press(page, "t")
    all_saved(page)
    said = labelled.judged()
    assert said[0].ranks == (0, 1, 1, 2) and order == [*[*shown][-1:], *[*shown][:-1]]
    assert [said[1].ranks[int(quality)] for quality in order] == [0, 1, 2, 3]
    assert said[2].ranks == (0, 0, 0, 0)
    assert page.locator("#empty-title").text_content() == "That is all for now"
    page.keyboard.press("u")
    page.wait_for_selector("#work:not([hidden])")


def test_clips_play_side_by_side_and_only_they_are_served(labelled, sign_in):
    imageio = pytest.importorskip("imageio.v2")
    import numpy as np

    for number, name in enumerate(("walks.gif", "falls.gif")):
        frames = [np.full((32, 32, 3), 40 * (number + each), np.uint8) for each in range(4)]
        imageio.mimsave(labelled.where.parent / name, frames)
    (labelled.where.parent / "model.txt").write_text("secret")
    clips = [["walks.gif", "falls.gif"], ["../../etc/passwd", "model.txt"]]
    labelled.fill([NewItem({"text": "Which one walks?"}, [Candidate({"media": name}) for name in names]) for names in clips])
    labelled.start()
    page = sign_in("anna")
    page.wait_for_function("[...document.images].length === 2 && [...document.images].every((image) => image.naturalWidth === 32)")
    assert "walks.gif" not in page.content()
    ours = page.evaluate("document.body.dataset.assignment")
    press(page, "1")
    other = page.evaluate("document.body.dataset.assignment")
    fetched = [
        page.evaluate("address => fetch(address).then((answer) => answer.status)", f"/label/media/{assignment}/{place}")
        for assignment, place in [(ours, 0), (other, 0), (other, 1), (ours, 2), (10**6, 0)]
    ]
    assert fetched == [200, 404, 404, 404, 404]


def test_the_report_is_the_owners(labelled, sign_in):
    labelled.fill([answers(number, raters=2) for number in range(10)])
    labelled.start()
    pages = [sign_in("anna"), sign_in("<b>ben</b>")]
    for page in pages:
        for _ in range(4):
            prefer_good(page)
        all_saved(page)
    page = pages[0]
    assert page.goto(f"{labelled.root}/preferences").status == 403
    assert page.goto(f"{labelled.root}/preferences/export/preference.jsonl").status == 403
    assert page.goto(f"{labelled.root}/preferences?key={KEY}").status == 200
    assert "8 judgements" in page.locator(".lead").text_content()
    assert page.locator("tbody th", has_text="<b>ben</b>").count() == 1
    with page.expect_download() as download:
        page.locator('a[href="/preferences/export/preference.jsonl"]').click()
    assert download.value.path().read_text().count('"chosen": "A good') == 4


def test_one_rater_cannot_answer_for_another(labelled, sign_in):
    labelled.fill([answers(number) for number in range(4)])
    labelled.start()
    page = sign_in("anna")
    post = """async ([path, body]) => {
        const headers = {'content-type': 'application/json'};
        const answer = await fetch(`/label/${path}`, {method: 'POST', headers, body: JSON.stringify(body)});
        return [answer.status, await answer.text()];
    }"""
    assignment = int(page.evaluate("document.body.dataset.assignment"))
    said = {"rater": "mallory", "assignment": assignment, "verdict": "a", "request": "x"}
    status, text = page.evaluate(post, ["judge", said])
    assert status == 409 and "not for mallory" in text
    for path, body in [
        ("judge", said | {"verdict": "best", "rater": "anna"}),
        ("next", {"rater": "\n"}),
        ("next", {"rater": "a", "count": 0}),
    ]:
        assert page.evaluate(post, [path, body])[0] in (409, 422)
    assert labelled.judged() == []


def test_a_closed_connection_is_told_and_mended(labelled, sign_in):
    labelled.fill([answers(number) for number in range(30)])
    labelled.start()
    page = sign_in("anna")
    labelled.kill()
    for _ in range(3):
        prefer_good(page)
    page.wait_for_function("document.getElementById('saved').textContent.includes('3 kept here')")
    time.sleep(0.3)
    labelled.start()
    all_saved(page)
    assert len(labelled.judged()) == 3
