"""One studio and one browser for a file of tests: both take seconds to start."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import pytest

TOKEN = "a-token-of-the-tests"
NAMES = ("chromium", "chromium-browser", "google-chrome")


class Served(NamedTuple):
    address: str
    """With the token."""
    root: str
    """Without, and without a slash at its end."""
    port: int


@pytest.fixture(scope="module")
def studio() -> Iterator[Served]:
    pytest.importorskip("nicegui")
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("served_studio.py")), TOKEN], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address, "the studio did not start"
    parts = urlsplit(address)
    assert parts.port is not None
    yield Served(address, f"http://{parts.netloc}", parts.port)
    process.terminate()
    assert process.wait(10) is not None


@pytest.fixture(scope="module")
def browser():
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as started:
        # Chromium's sandbox does not work for root.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        launched = started.chromium.launch(executable_path=program, args=[*arguments, "--disable-gpu"])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def context(browser, studio):
    """A browser that was let in. Whatever it asks for, and whatever its console says, is looked at after each test."""
    opened = browser.new_context(viewport={"width": 1100, "height": 800}, reduced_motion="reduce")
    opened.set_default_timeout(60_000)
    page = opened.new_page()
    page.goto(studio.address)
    page.wait_for_selector("h1")
    assert "token" not in page.url
    page.close()
    yield opened
    opened.close()


@pytest.fixture
def page(context, studio):
    """A tab on its own; at the end nothing was asked of another machine and no error was reported."""
    asked, errors = [], []

    def watch(opened):
        opened.on("request", lambda request: asked.append(request.url))
        opened.on("websocket", lambda socket: asked.append(socket.url.replace("ws:", "http:")))
        opened.on("console", lambda message: errors.append(message.text) if message.type in ("error", "warning") else None)
        opened.on("pageerror", lambda error: errors.append(str(error)))

    context.on("page", watch)
    opened = context.new_page()
    opened.errors = errors
    yield opened
    context.remove_listener("page", watch)
    for each in context.pages:
        each.close()
    elsewhere = [url for url in asked if not url.startswith((f"{studio.root}/", "data:", "blob:"))]
    assert asked and not elsewhere
    assert not errors
