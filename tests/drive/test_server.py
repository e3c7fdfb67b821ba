"""Hostile and clumsy clients: clear refusals, and the session goes on."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from http.client import HTTPConnection

import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests.run.harness import wait_until
from wasp_cli.drive import check as script
from wasp_cli.drive.desk import Desk, Frame
from wasp_cli.drive.server import BUSY, REFUSED, TOO_MUCH, Server, unpacked
from wasp_cli.errors import UsageError, WaspError


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server(Desk())
    server.start()
    yield server
    server.stop()


def get(server: Server, path: str, host: str | None = None) -> tuple[int, dict[str, str], bytes]:
    connection = HTTPConnection("127.0.0.1", server.port, timeout=300)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    answer = connection.getresponse()
    return (
        answer.status,
        {name.lower(): value for name, value in answer.getheaders()},
        answer.read(),
    )


def driver(server: Server, token: str | None = None, **headers: str) -> ClientConnection:
    address = (
        f"ws://127.0.0.1:{server.port}/socket?token={server.token if token is None else token}"
    )
    return connect(address, additional_headers=headers, ping_interval=None)


def state(ws: ClientConnection) -> dict[str, object]:
    return json.loads(ws.recv(timeout=300))


def test_the_page_needs_the_token(server: Server) -> None:
    assert get(server, "/")[0] == 403
    assert get(server, "/?token=guess")[0] == 403
    status, headers, body = get(server, f"/?token={server.token}")
    assert status == 200
    assert b"drive.js" in body
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "server" not in headers
    assert server.token.encode() not in body, "the address alone has it"


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "", "localhost.evil.example:80"]
)
def test_a_name_of_another_host_is_refused(server: Server, host: str) -> None:
    """What a page of another site reaches through its own name server (DNS rebinding). A tunnel
    may have another port.
    """
    assert get(server, f"/?token={server.token}", host)[0] in (400, 403)
    assert get(server, "/drive.js", host)[0] in (400, 403)
    for own in ("localhost:9000", "127.0.0.1:22", "[::1]:9000"):
        assert get(server, f"/?token={server.token}", own)[0] == 200


@pytest.mark.parametrize(
    "path",
    ["/../server.py", "/%2e%2e/server.py", "/index.html", "/drive.js/..", "/etc/passwd", "/socket"],
)
def test_nothing_that_is_asked_for_becomes_a_path(server: Server, path: str) -> None:
    assert get(server, path)[0] in (403, 404)


def test_a_socket_needs_token_and_origin(server: Server) -> None:
    for origin in ("http://evil.example", "null"):
        with pytest.raises(InvalidStatus) as refused:
            driver(server, Origin=origin)
        assert refused.value.response.status_code == 403
    for token in ("guess", ""):  # told so that a page can say it: it sees no status of HTTP
        with driver(server, token) as ws, pytest.raises(ConnectionClosed) as closed:
            ws.recv(timeout=300)
        assert closed.value.rcvd.code == REFUSED
    assert not server.desk.present
    with driver(server, Origin=f"http://127.0.0.1:{server.port}") as ws:
        assert state(ws)["phase"] == "starting"


def test_one_driver_at_a_time(server: Server) -> None:
    with driver(server) as first:
        state(first)
        with driver(server) as second, pytest.raises(ConnectionClosed) as closed:
            second.recv(timeout=300)
        assert closed.value.rcvd.code == BUSY
        server.desk.state("ready")
        assert state(first)["phase"] == "ready", "the first one drives on"
    wait_until(lambda: not server.desk.present)
    with driver(server) as third:
        assert state(third)["phase"] == "ready", "who comes later is told what goes on"


BAD = [
    "not json",
    "[]",
    "{}",
    '{"type": "input"}',
    '{"type": "steal"}',
    '{"type": "ask", "what": "../../etc"}',
    '{"type": "ack", "frame": -1}',
    '{"type": "input", "number": 1, "keys": [], "axes": [2, 0]}',
    '{"type": "input", "number": 1, "keys": [], "axes": [NaN, 0]}',
    '{"type": "input", "number": 1, "keys": ["' + "A" * 99 + '"], "axes": [0, 0]}',
    '{"type": "input", "number": 1e300, "keys": [], "axes": [0, 0]}',
    '{"type": "alive", "more": 1}',
    '{"type": "answers", "scales": {"mental": 101}}',
    b"\x00\x01binary",
]


@pytest.mark.parametrize("message", BAD, ids=range(len(BAD)))
def test_a_message_that_the_page_does_not_send_ends_the_connection_and_nothing_else(
    server: Server, message: str | bytes
) -> None:
    with driver(server) as ws:
        state(ws)
        ws.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            ws.recv(timeout=300)
        assert closed.value.rcvd.code == TOO_MUCH
    assert server.desk.held.stick.tolist() == [0.0, 0.0]
    wait_until(lambda: not server.desk.present)
    with driver(server) as ws:
        assert state(ws)["phase"] == "starting"


def test_a_giant_message_is_not_even_read(server: Server) -> None:
    with driver(server) as ws:
        state(ws)
        with suppress(ConnectionClosed):
            ws.send("x" * 50_000_000)
        with pytest.raises(ConnectionClosed):
            ws.recv(timeout=300)


def test_ten_thousand_messages_a_second_are_cut_off(server: Server) -> None:
    with driver(server) as ws:
        state(ws)
        with suppress(ConnectionClosed):
            for number in range(10_000):
                ws.send(
                    json.dumps(
                        {"type": "input", "number": number, "keys": ["ArrowUp"], "axes": [0.0, 0.0]}
                    )
                )
        with pytest.raises(ConnectionClosed) as closed:
            ws.recv(timeout=300)
        assert closed.value.rcvd.code == TOO_MUCH
    wait_until(lambda: not server.desk.present)
    assert server.desk.held.stick.tolist() == [0.0, 0.0], "nothing stays held"


def test_a_connection_that_says_nothing_is_lost(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wasp_cli.drive.server.SILENT", 0.3)
    with driver(server) as ws:
        state(ws)
        ws.send(json.dumps({"type": "input", "number": 1, "keys": ["ArrowUp"], "axes": [0.0, 0.0]}))
        wait_until(lambda: not server.desk.present)
    assert server.desk.held.keys == frozenset()


def test_a_new_frame_waits_for_the_last_one_to_be_drawn_and_old_ones_are_left_out(
    server: Server,
) -> None:
    with driver(server) as ws:
        state(ws)
        server.desk.show(Frame({"frame": 1}, b"one"))
        assert unpacked(ws.recv(timeout=300)) == ({"frame": 1}, b"one")  # type: ignore[arg-type]
        for number in (2, 3, 4):
            server.desk.show(Frame({"frame": number}, b""))
        with pytest.raises(TimeoutError):
            ws.recv(timeout=0.2)
        ws.send(json.dumps({"type": "ack", "frame": 1}))
        assert unpacked(ws.recv(timeout=300))[0] == {"frame": 4}  # type: ignore[arg-type]
        assert 0.0 < server.desk.round_trip < 300.0


def test_a_port_that_is_taken_is_said() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UsageError, match=r"cannot use port \d+"):
            Server(Desk(), taken.getsockname()[1])


def test_an_answer_that_comes_at_once_is_not_lost_and_one_to_another_form_does_not_count() -> None:
    """A script answers before the thread that asked has begun to wait; a second click may come
    when the next form is there.
    """
    desk = Desk(
        lambda: (
            [desk.answer(each) for each in ({"agreed": True}, {"agreed": None, "mental": 3.0})]
            if desk.outgoing()[0]
            else None
        )
    )
    asked = threading.Thread(
        target=lambda: found.append(desk.answers({"name": "consent", "scales": []})), daemon=True
    )
    found: list[object] = []
    asked.start()
    asked.join(300)
    assert found == [{"agreed": True}]


def test_a_scripted_driver_that_was_turned_away_connects_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
