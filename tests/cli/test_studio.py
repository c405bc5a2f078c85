"""``thorndike studio``: how it starts, what it says when it cannot, how it ends."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import pytest

from thorndike.cli import studio
from thorndike.cli.main import main


@pytest.mark.parametrize("port", ["-1", "65536", "x", "", "1.5", "٨٤٢٠"])
def test_a_wrong_port_is_one_line(port, capsys):
    assert main(["studio", f"--port={port}"]) == 2
    assert capsys.readouterr().err == (
        f"thorndike: argument --port: expected a port from 0 (any free one) to 65535; got '{port}' (see: thorndike studio --help)\n"
    )


@pytest.mark.parametrize("missing", ["nicegui", "mctx"])
def test_a_missing_extra_is_one_line(missing, capsys, monkeypatch):
    monkeypatch.setattr(studio, "find_spec", lambda name: None if name == missing else object())
    assert main(["studio"]) == 2
    assert capsys.readouterr().err == f"thorndike: the studio needs {missing}, which is not installed: pip install 'thorndike[web,games]'\n"


def test_a_game_that_is_not_there_is_one_line(capsys):
    assert main(["studio", "--game", "no_file.py:GAME"]) == 2
    assert capsys.readouterr().err == "thorndike: there is no file no_file.py: give the path of the file that defines the game\n"


def test_a_port_that_is_taken_is_one_line(capsys):
    pytest.importorskip("nicegui")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert main(["studio", "--port", str(port), "--json"]) == 2
    found = capsys.readouterr()
    assert json.loads(found.out)["error"].startswith(f"port {port} is taken") and found.err.count("\n") == 1


@pytest.mark.parametrize(("number", "status", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")])
def test_it_says_where_it_is_and_ends_in_order(number, status, word, tmp_path):
    pytest.importorskip("nicegui")
    words = [sys.executable, "-m", "thorndike", "studio", "--port", "0", "--output", str(tmp_path)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=os.environ)
    line = process.stdout.readline()
    found = re.fullmatch(r"The studio is at (http://127\.0\.0\.1:\d+)/\?token=([\w-]{32})\n", line)
    assert found, line
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(found[1], timeout=60)
    assert urllib.request.urlopen(f"{found[1]}/?token={found[2]}", timeout=60).status == 200
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (status, "", f"Ctrl-C ends it.\nthorndike: {word}\n")
    assert not list(tmp_path.iterdir()), "nothing is left in the folder it was started in"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--label", "nothing.db"], "--label nothing.db: there is no preference store"),
        (["--media", "films"], "--project and --media say what is judged: give --label STORE"),
    ],
)
def test_a_store_that_is_not_there_is_one_line(words, why, capsys):
    pytest.importorskip("nicegui")
    pytest.importorskip("mctx")
    assert main(["studio", *words]) == 2
    told = capsys.readouterr().err
    assert why in told and told.count("\n") == 1
