"""A socket without the token is closed, and a scripted driver that was turned away comes again."""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress

import pytest
from websockets.exceptions import InvalidMessage

from wasp_cli.drive import check as script
from wasp_cli.drive.desk import Desk
from wasp_cli.drive.server import Server
from wasp_cli.errors import WaspError


def opened(port: int, text: bytes) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), timeout=300)
    connection.sendall(text)
    return connection


def closed(connection: socket.socket) -> bool:
    """Wait for the other side to close; an error of time where it does not."""
    with suppress(ConnectionResetError):
        while connection.recv(4096):
            pass
    return True


def test_a_refused_socket_is_gone() -> None:
    """A handshake without the token, whose sender reads nothing and keeps its end open."""
    server = Server(Desk())
    server.start()
    asked = (
        b"GET /socket?token=guess HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    try:
        with opened(server.port, asked) as connection:
            assert closed(connection)
    finally:
        server.stop()


def test_a_scripted_driver_that_was_turned_away_connects_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[str] = []

    async def refused(address: str, **_: object) -> str:
        tried.append(address)
        if len(tried) < 3:
            raise InvalidMessage("did not receive a valid HTTP response")
        return "a connection"

    monkeypatch.setattr(script, "PAUSE", 0.01)
    monkeypatch.setattr(script, "connect", refused)
    assert asyncio.run(script.connected("http://127.0.0.1:1/?token=a")) == "a connection"
    monkeypatch.setattr(script, "ATTEMPTS", 2)
    tried.clear()
    with pytest.raises(WaspError, match="cannot connect"):
        asyncio.run(script.connected("http://127.0.0.1:1/?token=a"))
    assert tried == ["ws://127.0.0.1:1/socket?token=a"] * 2
