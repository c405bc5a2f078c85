"""The labelling page in the studio: one click there, one click back, behind the same gate."""

import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytest.importorskip("nicegui")
from playwright.sync_api import expect

from thorndike.language.preferences.judgements import Candidate, NewItem
from thorndike.language.preferences.store import Store
from web.conftest import TOKEN, Served

expect.set_options(timeout=60_000)


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    """A studio with a store of two pairs of clips, of which there are no films."""
    where = tmp_path_factory.mktemp("judged") / "choices.db"
    with Store(where) as store:
        pairs = [NewItem({"text": "Which?"}, [Candidate({"text": f"clip {n}-{side}"}) for side in (0, 1)]) for n in (0, 1)]
        store.add_items(store.project("clips"), pairs)
    words = [sys.executable, str(Path(__file__).with_name("served_studio.py")), TOKEN, "127.0.0.1", str(where)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    parts = urlsplit(address)
    assert parts.port is not None, "the studio did not start"
    yield Served(address, f"http://{parts.netloc}", parts.port)
    process.terminate()
    process.wait(10)


def test_one_click_leads_to_what_is_judged_and_one_click_back(page, studio):
    page.goto(studio.root)
    page.get_by_role("link", name="Judge clips").click()
    page.wait_for_url(f"{studio.root}/label")
    page.fill("#name", "me")
    page.keyboard.press("Enter")
    page.wait_for_function("document.body.dataset.assignment")
    page.keyboard.press("1")
    page.wait_for_function("document.getElementById('saved').textContent === 'All saved'")
    page.get_by_role("link", name="Thorndike").click()
    page.wait_for_url(f"{studio.root}/")
    expect(page.get_by_role("heading", name="Play")).to_be_visible()
    page.get_by_role("link", name="Judgements").click()
    expect(page.get_by_role("rowheader", name="me", exact=True)).to_be_visible()


@pytest.mark.parametrize("path", ["/label", "/label/about", "/label/static/label.js", "/preferences"])
def test_the_gate_of_the_studio_is_before_it(studio, path):
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(f"{studio.root}{path}", timeout=60)
