"""A web server on this machine alone, with a random token: the listening socket, who may ask, the
headers of every answer, its thread.

A page of another site cannot talk to it: Host, Origin and token are checked. Its own pages may load
nothing from anywhere else.
"""

from __future__ import annotations

import asyncio
import secrets
import socket
import threading
import time
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute

from wasp_cli.console import plain, say
from wasp_cli.errors import UsageError
from wasp_cli.tasks.foreign.started import unmarked

HOST = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost", "[::1]")
"""Names of this machine in Host and Origin: what a browser says here, or at the other end of an
SSH tunnel.
"""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""What a page may load and where it may send something: nothing but this server. It has no form
to send.
"""
KINDS = {".js": "text/javascript", ".css": "text/css"}  # of the files of a page
REFERRER = "same-origin"  # a POST names its origin only where the server itself may be told it


class LocalServer:
    """Serves some routes, from a thread of its own until it is stopped. Who asks is checked by
    the routes, with `local` and `known`.
    """

    def __init__(
        self, routes: Sequence[BaseRoute], port: int, command: str, **options: Any
    ) -> None:
        """Take a port, 0 for any free one. `command` printed the address, for whoever comes
        without its token; `options` are uvicorn's.
        """
        self.token = secrets.token_urlsafe(16)
        self._command = command
        self._socket = _listening(port)
        self.port: int = self._socket.getsockname()[1]
        config = uvicorn.Config(
            Starlette(routes=routes),
            log_level="error",
            lifespan="off",
            server_header=False,
            access_log=False,
            timeout_graceful_shutdown=2,
            http="h11",
            **options,
        )
        self._server = uvicorn.Server(config)
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def announce(self, what: str, address: str, *, opened: bool, more: str = "") -> None:
        """Say where to `what` here and from another machine, and open it in a browser where
        that is wanted.
        """
        say(f"{what} here: {address}")
        way = f"ssh -L {self.port}:{HOST}:{self.port} THIS-MACHINE"
        plain(f"from another machine: {way}, then open the same address there{more}")
        if opened:
            with suppress(webbrowser.Error), unmarked():  # it may stay open
                webbrowser.open(address)

    def start(self) -> None:
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._server.serve(sockets=[self._socket])),
            daemon=True,
            name="server",
        )
        self._thread.start()
        until = time.monotonic() + 10.0
        while not self._server.started and time.monotonic() < until:
            time.sleep(0.01)

    def stop(self) -> None:
        self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(5.0)

    def known(self, token: str | None) -> bool:
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    def forbidden(self) -> Response:
        return PlainTextResponse(
            f"not allowed: open the address that wasp {self._command} printed, with its token", 403
        )


def page(content: bytes, kind: str, policy: str = POLICY, status: int = 200) -> Response:
    """Return an answer that no other page can show and no cache keeps."""
    headers = {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": REFERRER,
        "Cache-Control": "no-store",
        "X-Frame-Options": "DENY",
    }
    kind = f"{kind}; charset=utf-8" if kind.startswith("text/") else kind
    return Response(content, status, headers=headers, media_type=kind)


def static(files: Mapping[str, Path], name: str) -> Response:
    """Return a file by its name among those of a page: what was asked for never becomes a path."""
    path = files.get(name)
    return (
        PlainTextResponse("not found", 404)
        if path is None
        else page(path.read_bytes(), KINDS[path.suffix])
    )


def local(host: str | None) -> bool:
    """Return whether a Host is a name of this machine, with whatever port: a tunnel may have
    another one.
    """
    if host is None:
        return False
    return (
        host[: host.rindex("]") + 1]
        if host.startswith("[") and "]" in host
        else host.partition(":")[0]
    ) in NAMES


def own_origin(host: str | None, origin: str | None) -> bool:
    return origin in (None, f"http://{host}")


def _listening(port: int) -> socket.socket:
    # With its protocol: asyncio then sends at once, and does not wait for more to send (Nagle),
    # which costs 40 ms an answer.
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
    except OSError as error:
        listening.close()
        raise UsageError(
            f"cannot use port {port}: {(error.strerror or str(error)).lower()}",
            "choose another one with --port",
        ) from error
    return listening
