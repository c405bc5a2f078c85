"""The gate: what must not pass does not pass, whichever method or socket it comes by; what may pass reaches the pages."""

import asyncio
import http.client
import re

import pytest

from thorndike.web.gate import Gate

TOKEN, PORT = "right", 8420
OURS = "127.0.0.1:8420"
COOKIE = f"other=1; thorndike_{PORT}={TOKEN}; more"
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE", "TRACE", "CONNECT", "ANYTHING")


async def _inside(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": [(b"x-inside", b"1")]})
    await send({"type": "http.response.body", "body": b"inside"})


def ask(
    *, method="GET", host=OURS, origin=None, cookie=COOKIE, path="/", query=b"", kind="http", bound="127.0.0.1", more=(), extensions=None
):
    """The messages that come back for one request."""
    headers = [(b"host", host.encode())] if host is not None else []
    headers += [(b"origin", origin.encode())] if origin is not None else []
    headers += [(b"cookie", cookie.encode())] if cookie is not None else []
    scope = {"type": kind, "path": path, "query_string": query, "headers": [*headers, *more], "extensions": extensions}
    scope |= {"method": method} if kind == "http" else {}
    sent = []

    async def send(message):
        sent.append(message)

    async def run():
        await Gate(_inside, TOKEN, bound, PORT)(scope, None, send)

    asyncio.run(run())
    return sent


def status(**request) -> int:
    first = ask(**request)[0]
    return 403 if first["type"] == "websocket.close" else first["status"]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_needs_the_token_this_host_and_this_origin(method):
    right = {"method": method, "origin": f"http://{OURS}"}
    assert status(**right) == 200
    wrong = [
        {"cookie": None},
        {"cookie": f"thorndike_{PORT}=wrong"},
        {"cookie": f"thorndike_{PORT}="},
        {"cookie": f"thorndike_1={TOKEN}"},
        {"host": None},
        {"host": "evil.example:8420"},
        {"host": "evil.example"},
        {"host": "127.0.0.1:9999"},
        {"host": "127.0.0.1"},
        {"host": "127.0.0.1.evil.example:8420"},
        {"host": "192.168.1.5:8420"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"origin": f"https://{OURS}"},
        {"origin": "http://localhost:8420"},
        {"more": [(b"host", b"evil.example")]},
        {"more": [(b"origin", b"http://evil.example")]},
    ]
    for change in wrong:
        sent = ask(**{**right, **change})
        assert sent[0]["status"] == 403, change
        body = sent[1]["body"]
        assert not body if method == "HEAD" else body.startswith(b"403: ") and body.count(b"\n") == 1


@pytest.mark.parametrize("method", METHODS)
def test_only_reading_may_come_without_an_origin(method):
    assert status(method=method) == (200 if method in ("GET", "HEAD", "OPTIONS") else 403)


def test_a_socket_needs_them_too():
    right = {"kind": "websocket", "origin": f"http://{OURS}"}
    assert status(**right) == 200
    for change in (
        {"cookie": None},
        {"origin": None},
        {"origin": "http://evil.example"},
        {"host": "evil.example:8420"},
        {"query": b"token=right", "cookie": None},
    ):
        assert ask(**{**right, **change}) == [{"type": "websocket.close", "code": 1008}]
        told = ask(**{**right, **change}, extensions={"websocket.http.response": {}})
        assert told[0]["status"] == 403 and told[0]["type"] == "websocket.http.response.start"


def test_the_token_in_the_address_becomes_a_cookie_and_leaves_the_address():
    sent = ask(cookie=None, path="/play/x", query=b"token=right&a=1")
    headers = dict(sent[0]["headers"])
    assert headers[b"set-cookie"] == b"thorndike_8420=right; Path=/; HttpOnly; SameSite=Strict"
    assert b'content="0;url=/play/x?a=1"' in sent[1]["body"] and b"right" not in sent[1]["body"]
    assert status(cookie=None, query=b"token=wrong") == 403
    assert status(cookie=None, query=b"token=right", method="POST", origin=f"http://{OURS}") == 403
    assert status(cookie=None, query=b"token=right", host="evil.example:8420") == 403


@pytest.mark.parametrize("path", ["//evil.example/", "/\\evil.example", '/"><script>', "///evil.example"])
def test_the_way_on_leads_to_no_other_host_and_holds_no_code(path):
    body = ask(cookie=None, path=path, query=b"token=right&q=%22%3E%3Cscript%3E")[1]["body"].decode()
    address = re.search(r'content="0;url=([^"]*)"', body)[1]
    assert re.match(r"/[^/\\]", address) and "<script" not in body


@pytest.mark.parametrize(
    ("bound", "host", "passes"),
    [
        ("127.0.0.1", "localhost:8420", True),
        ("127.0.0.1", "LOCALHOST:8420", True),
        ("::1", "[::1]:8420", True),
        ("192.168.1.5", "192.168.1.5:8420", True),
        ("192.168.1.5", "192.168.1.6:8420", False),
        ("0.0.0.0", "192.168.1.6:8420", True),
        ("0.0.0.0", "[fe80::1]:8420", True),
        ("0.0.0.0", "evil.example:8420", False),
        ("::", "evil.example:8420", False),
    ],
)
def test_hosts_are_those_that_it_is_bound_to(bound, host, passes):
    assert status(host=host, bound=bound) == (200 if passes else 403)


def test_pages_load_nothing_from_elsewhere_and_stand_in_no_frame():
    headers = dict(ask()[0]["headers"])
    policy = headers[b"content-security-policy"].decode()
    assert "default-src 'self'" in policy and "frame-ancestors 'none'" in policy and "http" not in policy
    assert headers[b"x-frame-options"] == b"DENY" and headers[b"x-inside"] == b"1"


# The same, of the whole studio.


def answer(studio, method, path, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=10)
    connection.putrequest(method, path, skip_host="host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    found = connection.getresponse()
    return found.status, found.read().decode(errors="replace")


SOCKET = {"upgrade": "websocket", "connection": "Upgrade", "sec-websocket-key": "dGhlIHNhbXBsZSBub25jZQ==", "sec-websocket-version": "13"}
SOCKET_PATH = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


def test_the_studio_refuses_strangers_everywhere(studio):
    cookie = {"cookie": f"thorndike_{studio.port}=a-token-of-the-tests"}
    assert answer(studio, "GET", "/", **cookie)[0] == 200
    for path in ("/", "/new/connect_four", "/studio/studio.css", "/_nicegui_ws/socket.io/?EIO=4&transport=polling", "/nothing", "/docs"):
        assert answer(studio, "GET", path)[0] == 403, path
        assert answer(studio, "GET", path, host=f"evil.example:{studio.port}", **cookie)[0] == 403, path
        assert answer(studio, "POST", path, origin="http://evil.example", **cookie)[0] == 403, path
        assert answer(studio, "POST", path, **cookie)[0] == 403, path
    for wrong in ({"origin": "http://evil.example", **cookie}, cookie, {"origin": studio.root}):
        found, line = answer(studio, "GET", SOCKET_PATH, **SOCKET, **wrong)
        assert found == 403 and line.startswith("403: ")
    assert answer(studio, "GET", "/docs", **cookie)[0] == 404


def test_a_socket_of_ours_is_let_in(studio):
    connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=10)
    headers = {**SOCKET, "origin": studio.root, "cookie": f"thorndike_{studio.port}=a-token-of-the-tests"}
    connection.request("GET", SOCKET_PATH, headers=headers)
    assert connection.getresponse().status == 101
    connection.close()
