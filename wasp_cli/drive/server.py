"""The web server of a session: one page, one socket, one driver; on this machine alone.

Nothing that comes over the network becomes a path or reaches the simulator unchecked: messages are bounded, parsed against models, and
counted. A page of another site cannot talk to it (Host, Origin and a random token are checked), and its own page may load nothing else.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
import struct
import threading
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import uvicorn
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from wasp_cli.drive.desk import Desk, Frame
from wasp_cli.errors import UsageError

HOST = "127.0.0.1"
NAMES = ("127.0.0.1", "localhost", "[::1]")
"""Names of this machine in Host and Origin: what a browser says here, or at the other end of an SSH tunnel."""
LONGEST = 8192
"""Bytes of a message."""
MOST = 300
"""Messages in a second; a page sends one for each key, frame and move of a stick."""
SILENT = 10.0
"""Seconds without any message after which a connection counts as lost; a page says something every second."""
PAGE = Path(__file__).parent / "page"
FILES = {"drive.js": "text/javascript", "drive.css": "text/css"}
POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; connect-src 'self'; base-uri 'none'; form-action 'none'"

REFUSED, BUSY, TOO_MUCH = 4403, 4409, 4429
"""Codes with which the socket closes: not allowed, somebody drives already, too many or too large messages."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


Unit = Annotated[float, Field(ge=-1.0, le=1.0)]
Word = Annotated[str, Field(max_length=24)]


class Input(_Message):
    """What is held down."""

    type: Literal["input"]
    number: Annotated[int, Field(ge=0, lt=2**31)]
    keys: Annotated[list[Word], Field(max_length=16)]
    axes: Annotated[list[Unit], Field(min_length=2, max_length=2)]


class Ack(_Message):
    """A frame was drawn."""

    type: Literal["ack"]
    frame: Annotated[int, Field(ge=0, lt=2**53)]


class Focus(_Message):
    """The window got or lost the focus."""

    type: Literal["focus"]
    there: bool


class Ask(_Message):
    """The driver asks for something."""

    type: Literal["ask"]
    what: Literal["go", "pause", "restart", "next", "end"]


class Answers(_Message):
    """A form was filled in."""

    type: Literal["answers"]
    agreed: bool | None = None
    scales: Annotated[dict[Word, Annotated[float, Field(ge=0.0, le=100.0)]], Field(max_length=32)] = {}


class Alive(_Message):
    """The page is there."""

    type: Literal["alive"]


MESSAGE: TypeAdapter[Any] = TypeAdapter(Annotated[Input | Ack | Focus | Ask | Answers | Alive, Field(discriminator="type")])


class Server:
    """Serves the page of a desk, from a thread of its own or until it is stopped."""

    def __init__(self, desk: Desk, port: int = 0) -> None:
        """Take a port, 0 for any free one.

        Raises:
            UsageError: the port is taken, or not allowed.
        """
        self.desk, self.token = desk, secrets.token_urlsafe(16)
        self.refused = 0
        """Requests, connections and messages that were turned away."""
        self._socket = _listening(port)
        self.port: int = self._socket.getsockname()[1]
        routes = [
            Route("/", self._index),
            Route("/{name}", self._file),
            WebSocketRoute("/socket", self._drive),
        ]
        config = uvicorn.Config(
            Starlette(routes=routes), log_level="error", ws_max_size=LONGEST, ws_max_queue=64, ws_ping_interval=None, lifespan="off",
            server_header=False, access_log=False, timeout_graceful_shutdown=2,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wake: asyncio.Event | None = None
        self._thread: threading.Thread | None = None
        desk.changed = self._changed

    @property
    def address(self) -> str:
        """Return what a browser opens."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    def start(self) -> None:
        """Serve from a thread; returns once it answers."""
        self._thread = threading.Thread(target=self._serve, daemon=True, name="server")
        self._thread.start()
        until = time.monotonic() + 10.0
        while not self._server.started and time.monotonic() < until:
            time.sleep(0.01)

    def stop(self) -> None:
        """End the connections and the thread."""
        self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(5.0)

    def _serve(self) -> None:
        asyncio.run(self._server.serve(sockets=[self._socket]))

    def _changed(self) -> None:
        """Wake the sender, from whatever thread."""
        loop, wake = self._loop, self._wake
        if loop is not None and wake is not None and not loop.is_closed():
            loop.call_soon_threadsafe(wake.set)

    # -- requests -----------------------------------------------------------------------------------------------------------------

    async def _index(self, request: Request) -> Response:
        if not (_local(request.headers.get("host")) and self._known(request.query_params.get("token"))):
            return self._forbidden()
        return _page((PAGE / "index.html").read_bytes(), "text/html")

    async def _file(self, request: Request) -> Response:
        # By name among FILES: what was asked for never becomes a path.
        kind = FILES.get(request.path_params["name"])
        if not _local(request.headers.get("host")):
            return self._forbidden()
        return PlainTextResponse("not found", 404) if kind is None else _page((PAGE / request.path_params["name"]).read_bytes(), kind)

    def _forbidden(self) -> Response:
        self.refused += 1
        return PlainTextResponse("not allowed: open the address that wasp drive printed, with its token", 403)

    def _known(self, token: str | None) -> bool:
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    # -- the socket ---------------------------------------------------------------------------------------------------------------

    async def _drive(self, ws: WebSocket) -> None:
        host, origin = ws.headers.get("host"), ws.headers.get("origin")
        # Browsers always name an origin; programs on this machine, which know the token, need not.
        allowed = _local(host) and origin in (None, f"http://{host}") and self._known(ws.query_params.get("token"))
        if not allowed:
            self.refused += 1
            await ws.close(REFUSED)
            return
        await ws.accept()
        if not self.desk.come():
            await ws.close(BUSY, "somebody drives already, in another window")
            return
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        sender = asyncio.create_task(self._send(ws))
        try:
            await self._receive(ws)
        except (WebSocketDisconnect, RuntimeError, TimeoutError):
            pass
        finally:
            self.desk.leave()
            sender.cancel()
            self._wake = None

    async def _send(self, ws: WebSocket) -> None:
        assert self._wake is not None
        wake = self._wake
        while True:
            wake.clear()
            messages, frame = self.desk.outgoing()
            for message in messages:
                await ws.send_text(json.dumps(message))
            if frame is not None:
                await ws.send_bytes(packed(frame))
            if not messages and frame is None:
                await wake.wait()

    async def _receive(self, ws: WebSocket) -> None:
        second, count = 0.0, 0
        while True:
            received = await asyncio.wait_for(ws.receive(), SILENT)
            if received["type"] == "websocket.disconnect":
                return
            now = time.monotonic()
            if now - second > 1.0:
                second, count = now, 0
            count += 1
            if count > MOST:
                await self._refuse(ws, "too many messages")
                return
            text = received.get("text")
            try:
                if text is None or len(text) > LONGEST:
                    raise ValueError("not a text")
                message = MESSAGE.validate_json(text)
            except (ValidationError, ValueError):
                await self._refuse(ws, "a message that the page does not send")
                return
            self._take(message)

    async def _refuse(self, ws: WebSocket, why: str) -> None:
        self.refused += 1
        await ws.close(TOO_MUCH, why)

    def _take(self, message: Any) -> None:
        desk = self.desk
        if isinstance(message, Input):
            desk.controls.hold(frozenset(message.keys), (message.axes[0], message.axes[1]), message.number)
        elif isinstance(message, Ack):
            desk.acknowledged(message.frame)
        elif isinstance(message, Focus):
            desk.focus(message.there)
        elif isinstance(message, Ask):
            desk.ask(message.what)
        elif isinstance(message, Answers):
            desk.answer({"agreed": message.agreed, **message.scales})


def packed(frame: Frame) -> bytes:
    """Pack a frame: length of the header as uint32 (little endian), the header as JSON, then the pixels."""
    header = json.dumps(frame.header).encode()
    return struct.pack("<I", len(header)) + header + frame.pixels


def unpacked(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return header and pixels of a packed frame."""
    (length,) = struct.unpack_from("<I", data)
    header: dict[str, Any] = json.loads(data[4 : 4 + length])
    return header, data[4 + length :]


def _page(content: bytes, kind: str) -> Response:
    headers = {
        "Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store", "X-Frame-Options": "DENY",
    }  # fmt: skip
    return Response(content, headers=headers, media_type=f"{kind}; charset=utf-8")


def _local(host: str | None) -> bool:
    """Whether a Host is a name of this machine, with whatever port: a tunnel may have another one."""
    if host is None:
        return False
    name = host[: host.rindex("]") + 1] if host.startswith("[") and "]" in host else host.partition(":")[0]
    return name in NAMES


def _listening(port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
    except OSError as error:
        listening.close()
        raise UsageError(f"cannot use port {port}: {(error.strerror or str(error)).lower()}", "choose another one with --port") from error
    return listening
