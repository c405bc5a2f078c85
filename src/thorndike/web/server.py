"""Starting and ending the studio: one NiceGUI app behind one gate, on this machine unless another address is asked for."""

import contextlib
import errno
import secrets
import socket
from collections.abc import Callable, Sequence

import uvicorn
from fastapi import FastAPI
from nicegui import core, ui

from thorndike.errors import UserError
from thorndike.web.board import add_board
from thorndike.web.frame import serve_static_files
from thorndike.web.gate import Gate
from thorndike.web.home import Door, add_home
from thorndike.web.opponents import Opponents
from thorndike.web.studio import Studio

_RECONNECT_S = 30.0
"""How long the server keeps a page whose connection dropped; afterwards it loads anew, with the same game."""
_GRACEFUL_S = 1


def serve(
    games: Sequence[str],
    opponents: Opponents,
    host: str,
    port: int,
    told: Callable[[str], None],
    token: str | None = None,
    doors: Sequence[Door] = (),
) -> None:
    """Serve until the process is asked to stop. ``told`` gets the address, token included, as soon as it answers.

    Raises UserError where the address cannot be had. One studio a process: NiceGUI has one app.
    """
    studio = Studio(games, opponents)
    try:
        serve_app(_pages(studio, doors), host, port, lambda root, token: told(f"{root}/?token={token}"), token)
    finally:
        studio.close()


def serve_app(app: FastAPI, host: str, port: int, told: Callable[[str, str], None], token: str | None = None) -> None:
    """Serve an app behind the gate until the process is asked to stop. ``told`` gets its root address and the token, once it answers.

    Raises UserError where the address cannot be had.
    """
    token = token or secrets.token_urlsafe(24)
    bound = _bind(host, port)
    port = bound.getsockname()[1]
    gate = Gate(app, token, host, port)
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    config = uvicorn.Config(gate, log_level="critical", access_log=False, timeout_graceful_shutdown=_GRACEFUL_S, server_header=False)
    server = uvicorn.Server(config)
    bound.listen(128)
    told(f"http://{shown}:{port}", token)
    try:
        server.run(sockets=[bound])
    finally:
        with contextlib.suppress(OSError):
            bound.close()


def _pages(studio: Studio, doors: Sequence[Door]) -> FastAPI:
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)
    for door in doors:
        door.add(app)
    serve_static_files()
    add_home(studio, doors)
    add_board(studio)
    core.app.config.socket_io_js_transports = ["websocket", "polling"]
    ui.run_with(
        app, title="Thorndike", dark=None, language="en-US", tailwind=False, show_welcome_message=False, reconnect_timeout=_RECONNECT_S
    )
    return app


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            raise UserError(f"port {port} is taken, perhaps by another studio: end that, or take any free one with --port 0") from error
        if error.errno == errno.EACCES:
            raise UserError(f"port {port} is not for ordinary users: take one above 1023") from error
        raise UserError(f"--host {host}: {error.strerror}; it must be an address of this machine, such as 127.0.0.1") from error
    return bound
