"""The web server of a session: one page, one socket and one driver, only on this machine.

Nothing that comes over the network becomes a path or reaches the simulator unchecked: messages are
limited in size and number, and parsed by models. Pages of other sites cannot connect, since Host,
Origin and a random token are checked, and its own page may load nothing from elsewhere.
"""

from __future__ import annotations

import asyncio
import json
import struct
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from wasp_cli.drive.desk import Desk, Frame
from wasp_cli.web import LocalServer, local, own_origin, page, static

LONGEST = 8192  # bytes of a message
MOST = 2000
"""Messages that are allowed in a second. A page sends one for each key, frame and move of a stick;
a scripted driver at 40 times the speed sends a thousand.
"""
# seconds without a message after which a connection counts as lost; a page sends one every second
SILENT = 10.0
PAGE = Path(__file__).parent / "page"
FILES = {name: PAGE / name for name in ("drive.js", "drive.css")}

REFUSED = 4403
BUSY = 4409
TOO_MUCH = 4429
"""Codes with which the socket closes: not allowed, somebody drives already, or too many or invalid
messages.
"""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


Unit = Annotated[float, Field(ge=-1.0, le=1.0)]
Word = Annotated[str, Field(max_length=24)]


class Input(_Message):
    """The state of keys and sticks, whenever it changes; `axes` are forward and left in [-1, 1]."""

    type: Literal["input"]
    number: Annotated[int, Field(ge=0, lt=2**31)]
    keys: Annotated[list[Word], Field(max_length=16)]
    axes: Annotated[list[Unit], Field(min_length=2, max_length=2)]


class Ack(_Message):
    """The page has drawn a frame."""

    type: Literal["ack"]
    frame: Annotated[int, Field(ge=0, lt=2**53)]


class Focus(_Message):
    """The window has got or lost the focus."""

    type: Literal["focus"]
    there: bool


class Ask(_Message):
    """The driver asks for something, by a button or a key."""

    type: Literal["ask"]
    what: Literal["go", "pause", "restart", "next", "end"]


class Answers(_Message):
    """The answers to a form: a consent, or a number from 0 to 100 for each scale."""

    type: Literal["answers"]
    agreed: bool | None = None
    scales: Annotated[
        dict[Word, Annotated[float, Field(ge=0.0, le=100.0)]], Field(max_length=32)
    ] = {}


class Alive(_Message):
    """Sent every second, so that a dead connection is noticed."""

    type: Literal["alive"]


MESSAGE: TypeAdapter[Any] = TypeAdapter(
    Annotated[Input | Ack | Focus | Ask | Answers | Alive, Field(discriminator="type")]
)


class Server(LocalServer):
    """Serves the page and its socket for one desk; `port` 0 takes a free one."""

    def __init__(self, desk: Desk, port: int = 0) -> None:
        self.desk = desk
        routes = [
            Route("/", self._index),
            Route("/{name}", self._file),
            WebSocketRoute("/socket", self._drive),
        ]
        super().__init__(
            routes, port, "drive", ws_max_size=LONGEST, ws_max_queue=64, ws_ping_interval=None
        )

    async def _index(self, request: Request) -> Response:
        if not (
            local(request.headers.get("host")) and self.known(request.query_params.get("token"))
        ):
            return self.forbidden()
        return page((PAGE / "index.html").read_bytes(), "text/html")

    async def _file(self, request: Request) -> Response:
        if not local(request.headers.get("host")):
            return self.forbidden()
        return static(FILES, request.path_params["name"])

    async def _drive(self, ws: WebSocket) -> None:
        host = ws.headers.get("host")
        origin = ws.headers.get("origin")
        if not (local(host) and own_origin(host, origin)):
            await ws.close(REFUSED)
            return
        await ws.accept()
        if not self.known(ws.query_params.get("token")):
            # after accepting it: a page cannot read the code of a connection that was refused
            await ws.close(REFUSED)
            return
        if not self.desk.come():
            await ws.close(BUSY, "somebody drives already, in another window")
            return
        loop = asyncio.get_running_loop()
        wake = asyncio.Event()

        def changed() -> None:
            with suppress(RuntimeError):  # the loop is closed: the server was stopped
                loop.call_soon_threadsafe(wake.set)

        self.desk.changed = changed
        sender = asyncio.create_task(self._send(ws, wake))
        try:
            # The page has gone, closed while something was sent, or was silent for too long: the
            # desk is told below, and the world pauses.
            with suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                await self._receive(ws)
        finally:
            self.desk.leave()
            sender.cancel()

    async def _send(self, ws: WebSocket, wake: asyncio.Event) -> None:
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
        second = 0.0
        count = 0
        while True:
            received = await asyncio.wait_for(ws.receive(), SILENT)
            if received["type"] == "websocket.disconnect":
                return
            now = time.monotonic()
            if now - second > 1.0:
                second = now
                count = 0
            count += 1
            if count > MOST:
                await ws.close(TOO_MUCH, "too many messages")
                return
            try:
                # `ws_max_size` limits its length to LONGEST.
                self._take(MESSAGE.validate_json(received.get("text") or ""))
            except ValidationError:
                await ws.close(TOO_MUCH, "a message that the page does not send")
                return

    def _take(self, message: Any) -> None:
        desk = self.desk
        if isinstance(message, Input):
            desk.hold(frozenset(message.keys), (message.axes[0], message.axes[1]), message.number)
        elif isinstance(message, Ack):
            desk.acknowledged(message.frame)
        elif isinstance(message, Focus):
            desk.focus(message.there)
        elif isinstance(message, Ask):
            desk.ask(message.what)
        elif isinstance(message, Answers):
            desk.answer({"agreed": message.agreed, **message.scales})


def packed(frame: Frame) -> bytes:
    """Return a frame as one message: the length of the header (uint32, little-endian), the header
    as JSON, and the pixels.
    """
    header = json.dumps(frame.header).encode()
    return struct.pack("<I", len(header)) + header + frame.pixels


def unpacked(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return header and pixels of a message; the inverse of `packed`."""
    (length,) = struct.unpack_from("<I", data)
    header: dict[str, Any] = json.loads(data[4 : 4 + length])
    return header, data[4 + length :]
