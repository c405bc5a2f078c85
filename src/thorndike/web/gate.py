"""The one gate of the studio, before any routing: every request and every socket names this host, comes from its own pages, and is let in.

A page of somebody else's, open in the same browser, can send requests to a local server. The Host header tells when a foreign name was
bent to this machine (DNS rebinding), the Origin header tells whose page asks, the token tells that it is the person who started the studio.
"""

import hmac
import ipaddress
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from html import escape
from typing import TypeAlias
from urllib.parse import parse_qsl, quote, urlencode

Message: TypeAlias = MutableMapping[str, object]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]
Scope: TypeAlias = MutableMapping[str, object]
App: TypeAlias = Callable[[Scope, Receive, Send], Awaitable[None]]
Headers: TypeAlias = list[tuple[bytes, bytes]]

_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
_TEXT: Headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"cache-control", b"no-store")]


class Gate:
    """An ASGI application around another one: what does not pass is answered 403 and one line, and never reaches the other."""

    def __init__(self, app: App, token: str, host: str, port: int) -> None:
        """``host`` and ``port`` are what the server is bound to."""
        self.app, self.token, self.port = app, token, port
        self.cookie = f"thorndike_{port}"
        self.names = {"127.0.0.1", "localhost", "[::1]"} | ({f"[{host}]" if ":" in host else host.lower()} - {"0.0.0.0", "[::]"})
        self.any_address = host in ("0.0.0.0", "::")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through or refuse it."""
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        headers = _headers(scope)
        refusal = self._refusal(scope, headers)
        if refusal is None and self._shows_token(scope):
            return await self._let_in(scope, send)
        if refusal is None and not self._has_cookie(headers):
            refusal = "open the address that `thorndike studio` printed: it holds the token that this studio asks for"
        if refusal is not None:
            return await _refuse(scope, send, refusal)
        await self.app(scope, receive, self._guarded(scope, headers, send))

    def _refusal(self, scope: Scope, headers: Headers) -> str | None:
        hosts, origins = _values(headers, b"host"), _values(headers, b"origin")
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return "the Host header does not name this studio"
        unsafe = scope["type"] == "websocket" or scope.get("method") not in _SAFE_METHODS
        if any(origin != f"http://{hosts[0]}" for origin in origins) or (unsafe and len(origins) != 1):
            return "the Origin header does not name this studio: the request comes from somebody else's page"
        return None

    def _is_ours(self, host: str) -> bool:
        name, _, port = host.lower().rpartition(":")
        if port != str(self.port):
            # Browsers leave the port out where it is HTTP's own.
            name, port = (host.lower(), "80") if self.port == 80 else ("", "")
        if name in self.names:
            return True
        # Bound to every address: any of them may be meant, but no name, for a name can be bent.
        return self.any_address and _is_address(name.strip("[]"))

    def _shows_token(self, scope: Scope) -> bool:
        if scope["type"] != "http" or scope["method"] != "GET":
            return False
        return any(name == "token" and self._is_token(value) for name, value in _query(scope))

    def _has_cookie(self, headers: Headers) -> bool:
        pairs = (pair.strip().partition("=") for line in _values(headers, b"cookie") for pair in line.split(";"))
        return any(name == self.cookie and self._is_token(value) for name, _, value in pairs)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(errors="replace"), self.token.encode())

    async def _let_in(self, scope: Scope, send: Send) -> None:
        """A page that goes on to the same address without the token. Not a redirect: that would still count as asked for by another
        page, from which the link may have been followed, and the strict cookie would not be sent along."""
        kept = urlencode([(name, value) for name, value in _query(scope) if name != "token"])
        # One slash: two would name another host.
        address = "/" + quote(str(scope["path"]).lstrip("/")) + (f"?{kept}" if kept else "")
        page = f'<!doctype html><title>Thorndike</title><meta http-equiv="refresh" content="0;url={escape(address)}">'
        headers: Headers = [
            (b"content-type", b"text/html; charset=utf-8"),
            (b"cache-control", b"no-store"),
            (b"referrer-policy", b"no-referrer"),
            (b"set-cookie", f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict".encode()),
        ]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": page.encode()})

    def _guarded(self, scope: Scope, headers: Headers, send: Send) -> Send:
        """Adds what tells the browser to load nothing from elsewhere and to show this in nobody's frame."""
        host = _values(headers, b"host")[0]
        # NiceGUI builds its pages with inline scripts and `new Function`.
        policy = (
            "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
            f"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws://{host}; "
            "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
        )
        added: Headers = [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"x-frame-options", b"DENY"),
            (b"referrer-policy", b"same-origin"),
        ]

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                sent = message.get("headers", ())
                message["headers"] = [*(sent if isinstance(sent, Iterable) else ()), *added]
            await send(message)

        return guarded if scope["type"] == "http" else send


async def _refuse(scope: Scope, send: Send, why: str) -> None:
    body = f"403: {why}\n".encode()
    prefix = "" if scope["type"] == "http" else "websocket."
    extensions = scope.get("extensions")
    if prefix and not (isinstance(extensions, dict) and "websocket.http.response" in extensions):
        # Before it was accepted, closing is a refusal: the server answers 403.
        return await send({"type": "websocket.close", "code": 1008})
    await send({"type": f"{prefix}http.response.start", "status": 403, "headers": _TEXT})
    await send({"type": f"{prefix}http.response.body", "body": b"" if scope.get("method") == "HEAD" else body})


def _headers(scope: Scope) -> Headers:
    headers = scope["headers"]
    assert isinstance(headers, Iterable)
    return list(headers)


def _values(headers: Headers, wanted: bytes) -> list[str]:
    return [value.decode("latin-1") for name, value in headers if name.lower() == wanted]


def _query(scope: Scope) -> list[tuple[str, str]]:
    query = scope["query_string"]
    assert isinstance(query, bytes)
    return parse_qsl(query.decode("latin-1"), keep_blank_values=True)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
