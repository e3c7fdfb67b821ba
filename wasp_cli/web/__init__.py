"""A web server that only this machine can reach, with a random token: its socket, the checks of
requests, the headers of answers, and its thread.

Pages of other sites cannot talk to it, since Host, Origin and token are checked. Its own pages may
load nothing from elsewhere.
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
"""Names of this machine in Host and Origin: as a browser here sends them, or one at the other end
of an SSH tunnel.
"""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""The Content-Security-Policy of a page: it may load from and connect to this server only, and send
no forms.
"""
KINDS = {".js": "text/javascript", ".css": "text/css"}  # of the files of a page
REFERRER = "same-origin"  # a POST names its origin only where the server itself may be told it


class LocalServer:
    """Serves some routes from a thread of its own. The routes check requests themselves, with
    `local` and `known`.
    """

    def __init__(
        self, routes: Sequence[BaseRoute], port: int, command: str, **options: Any
    ) -> None:
        """Take a port; 0: any free one.

        Args:
            command: the command of `wasp` that prints the address, for `forbidden`.
            options: of uvicorn.

        Raises:
            UsageError: the port cannot be used.
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
        """The address of the first page, with the token."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def announce(self, what: str, address: str, *, opened: bool, more: str = "") -> None:
        """Print how to `what` here and from another machine, and open the address in a browser if
        `opened`.
        """
        say(f"{what} here: {address}")
        way = f"ssh -L {self.port}:{HOST}:{self.port} THIS-MACHINE"
        plain(f"from another machine: {way}, then open the same address there{more}")
        if opened:
            with suppress(webbrowser.Error), unmarked():  # the browser may outlive this process
                webbrowser.open(address)

    def start(self) -> None:
        """Serve from a thread of its own; returns when the server answers, after 10 s at the
        latest.
        """
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
        """Ask the server to end, and wait up to 5 s for its thread."""
        self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(5.0)

    def known(self, token: str | None) -> bool:
        """Return whether a token is the right one, in constant time."""
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    def forbidden(self) -> Response:
        """Return the answer to a request without the token: 403, with what to do."""
        return PlainTextResponse(
            f"not allowed: open the address that wasp {self._command} printed, with its token", 403
        )


def page(content: bytes, kind: str, policy: str = POLICY, status: int = 200) -> Response:
    """Return an answer that no other page can embed and no cache keeps."""
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
    """Return one of a page's files by its name. The name is only looked up, and never becomes a
    path.
    """
    path = files.get(name)
    if path is None:
        return PlainTextResponse("not found", 404)
    return page(path.read_bytes(), KINDS[path.suffix])


def local(host: str | None) -> bool:
    """Return whether a Host is a name of this machine, with any port: a tunnel may have another
    one.
    """
    if host is None:
        return False
    name = host.partition(":")[0]
    if host.startswith("[") and "]" in host:  # IPv6
        name = host[: host.rindex("]") + 1]
    return name in NAMES


def own_origin(host: str | None, origin: str | None) -> bool:
    """Return whether an Origin is that of the server itself, or missing, as in requests that are
    not cross-origin.
    """
    return origin in (None, f"http://{host}")


def _listening(port: int) -> socket.socket:
    # With the protocol given, asyncio turns off Nagle's algorithm, which would cost 40 ms for each
    # answer.
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
