"""Connections without the token that never say anything whole: they are closed, and a session hardly notices them."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage
from websockets.sync.client import ClientConnection

from tests.drive.test_server import driver, get, state
from tests.view.conftest import viewed
from wasp_cli.drive import check as script
from wasp_cli.drive.desk import Desk
from wasp_cli.drive.server import TOO_MUCH, Server
from wasp_cli.errors import WaspError
from wasp_cli.web import guard
from wasp_cli.web.server import LocalServer

HALVES = {
    "nothing": b"",
    "a line": b"GET / HTTP/1.1\r\n",
    "no end of headers": b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ",
    "half a body": b"POST /note HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n\r\nkey=",
    "half a second request": b"GET /none HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /none HTTP/1.1\r\nHost: ",
}


@pytest.fixture(params=["drive", "view"])
def server(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[LocalServer]:
    with ExitStack() as stack:
        if request.param == "view":
            (tmp_path / "results" / "store" / "evaluate").mkdir(parents=True)
            yield stack.enter_context(viewed(tmp_path / "results"))
        else:
            made = Server(Desk())
            made.start()
            stack.callback(made.stop)
            yield made


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


@pytest.mark.parametrize("half", HALVES)
def test_half_a_request_is_not_waited_for(half: str, server: LocalServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "PATIENCE", 0.4)
    with opened(server.port, HALVES[half]) as connection:
        # uvicorn itself closes what says nothing after an answer; what goes on to say a little it keeps
        for _ in range(3):
            time.sleep(0.1)
            with suppress(OSError):
                connection.sendall(b"a" if HALVES[half] else b"")
        assert closed(connection)


def to_the_end(ws: ClientConnection) -> None:
    while True:
        ws.recv(timeout=300)


def test_the_driver_is_no_such_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "PATIENCE", 6.0)  # for a handshake on a busy machine
    server = Server(Desk())
    server.start()
    try:
        with driver(server) as ws:
            state(ws)
            time.sleep(6.5)
            ws.send(json.dumps({"type": "alive"}))
            ws.send(json.dumps({"type": "ask", "what": "nothing"}))
            with pytest.raises(ConnectionClosed) as caught:
                to_the_end(ws)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == TOO_MUCH, "for what it said, and not for its silence"
    finally:
        server.stop()


def test_only_some_wait_at_once_and_a_whole_request_is_answered(server: LocalServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "PATIENCE", 1000.0)
    most, waiting = guard.most_waiting(), []
    try:
        for _ in range(most + 40):
            waiting.append(opened(server.port, HALVES["a line"]))
        assert all(closed(each) for each in waiting[:30]), "those that have waited longest"
        assert get(server, "/")[0] == 403  # type: ignore[arg-type]
        waiting[-1].settimeout(0.1)
        with pytest.raises(TimeoutError):
            waiting[-1].recv(1)
    finally:
        for each in waiting:
            each.close()


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
