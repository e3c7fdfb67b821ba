"""Who may ask: token, Host, Origin; nothing that is asked for becomes a path; and the command
as a process.
"""

import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import quote

import pyarrow as pa
import pytest

from tests.commands import run_here
from tests.view.conftest import brought, viewed
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE
from wasp_cli.view.server import ViewServer

LABEL = "goal1 s1 human noisy=0.45"
CELL = "/cell/" + quote(LABEL)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ViewServer]:
    with viewed(brought(tmp_path_factory.mktemp("view") / "results", LABEL)) as running:
        yield running


def ask(
    server: ViewServer,
    path: str,
    method: str = "GET",
    body: str | None = None,
    known: bool = True,
    **headers: str,
) -> tuple[int, dict[str, str], str]:
    connection = HTTPConnection("127.0.0.1", server.port, timeout=600)
    if known:
        headers["Cookie"] = f"wasp_view_{server.port}={server.token}"
    connection.request(method, path, body, headers)
    answer = connection.getresponse()
    return (
        answer.status,
        {name.lower(): value for name, value in answer.getheaders()},
        answer.read().decode("utf-8", "replace"),
    )


PLACES = (
    "/",
    "/cells",
    "/cells/numbers",
    CELL,
    f"{CELL}/episode/0",
    f"{CELL}/episode/0/explain?step=3",
    "/static/view.js",
    "/static/sort.js",
)


@pytest.mark.parametrize("place", PLACES)
def test_every_page_needs_the_token_and_may_load_nothing_from_elsewhere(
    server: ViewServer, place: str
) -> None:
    assert ask(server, place, known=False)[0] == 403
    assert ask(server, place, known=False, Cookie=f"wasp_view_{server.port}=guess")[0] == 403
    assert (
        ask(server, place + ("&" if "?" in place else "?") + "token=guess", known=False)[0] == 403
    )
    for host in ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80"):
        assert ask(server, place, Host=host)[0] == 403
    assert (
        ask(server, place, "POST", "text=x", Origin=f"http://127.0.0.1:{server.port}")[0] == 405
    ), "nothing can be sent"
    status, headers, body = ask(server, place)
    assert status == 200
    if place != "/cells/numbers":
        assert headers["content-security-policy"].startswith(
            "default-src 'none'; script-src 'self'; style-src 'self'"
        )
        assert (headers["x-frame-options"], headers["referrer-policy"]) == ("DENY", "same-origin")
    assert server.token not in body
    assert "<form method" not in body


def test_the_token_becomes_a_cookie_that_no_script_and_no_other_site_gets(
    server: ViewServer,
) -> None:
    status, headers, _ = ask(server, f"{CELL}/episode/0?step=3&token={server.token}", known=False)
    assert (status, headers["location"]) == (303, f"{CELL}/episode/0?step=3".replace("%3D", "="))
    assert quote(f"/compare/cells?a={LABEL}&b=x", "/?=&") in server.opening(
        f"/compare/cells?a={LABEL}&b=x"
    ), "a terminal finds it whole"
    assert "HttpOnly" in headers["set-cookie"]
    assert "samesite=lax" in headers["set-cookie"].lower()


ODD = [
    "/static/../server.py",
    "/static/%2e%2e/server.py",
    "/static/base.html",
    "/cell/../../etc/passwd",
    "/cell/%2e%2e%2f%2e%2e",
    "/film/../x/0/film",
    "/film/0123456789abcdef0123/0/film",
    f"{CELL}/episode/99",
    f"{CELL}/episode/{'9' * 5000}",
    "/cell/x",
    f"{CELL}/episode/0?step=x",
    f"{CELL}/episode/0?step={2**63}",
]


def test_nothing_that_is_asked_for_becomes_a_path(server: ViewServer) -> None:
    for path in ODD:
        status, _, body = ask(server, path)
        assert (status, "root:" in body) == (404, False), path


def test_a_film_is_only_begun_by_a_page_of_ours(server: ViewServer) -> None:
    here = f"http://127.0.0.1:{server.port}"
    film = f"/film/{server.site.cells.listed()[0].key}/0/film"
    assert ask(server, film, "POST")[0] == 403, "no page of ours asks without its origin"
    for origin in ("http://evil.example", "null", here + ".evil.example", "http://127.0.0.1:1"):
        assert ask(server, film, "POST", Origin=origin)[0] == 403
    assert ask(server, film, "POST", known=False, Origin=here)[0] == 403
    assert ask(server, film, "POST", Host="evil.example", Origin="http://evil.example")[0] == 403
    assert ask(server, "/film/../../etc/0/film", "POST", Origin=here)[0] == 404
    assert ask(server, film.replace("/film/", "/film/0123456789/"), "POST", Origin=here)[0] == 404
    assert json.loads(ask(server, film)[2])["state"] == "absent"
    assert ask(server, f"{film}/frame/0")[0] == 404
    assert json.loads(ask(server, film, "POST", Origin=here)[2])["state"] == "drawing"


def test_the_pages_change_nothing(server: ViewServer) -> None:
    store = server.site.layout.store
    before = {path: path.stat().st_mtime_ns for path in Path(store).rglob("*")}
    for place in PLACES:
        ask(server, place)
    assert {path: path.stat().st_mtime_ns for path in Path(store).rglob("*")} == before


def test_a_session_of_a_person_shows_who_drove_and_how_well_in_time(server: ViewServer) -> None:
    cell = server.site.cells.listed()[0]
    session = {"participant": 7, "sittings": [{"begun": "2026-05-01T12:00:00"}]}
    folder = server.site.layout.artifact("evaluate", cell.key)
    assert "The session" not in ask(server, CELL)[2]
    (folder / SESSION_FILE).write_text(json.dumps(session), encoding="utf-8")
    beat = dict.fromkeys(BEAT.names, 0) | {
        "late": True,
        "focused": True,
        "keys": "",
        "decision_ms": 7.5,
    }
    write_table(pa.Table.from_pylist([beat], BEAT), folder / TIMING_FILE)
    try:
        body = ask(server, CELL)[2]
    finally:
        (folder / SESSION_FILE).unlink()
        (folder / TIMING_FILE).unlink()
    facts = {
        "participant": 7,
        "sittings 1: begun": "2026-05-01T12:00:00",
        "timing: late": 1,
        "timing: decision_p50_ms": 7.5,
    }
    for name, value in facts.items():
        assert f"<dt>{name}</dt><dd>{value}</dd>" in body


def test_it_serves_until_it_is_interrupted(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", LABEL)
    command = [
        sys.executable,
        "-m",
        "wasp_cli",
        "view",
        str(results),
        "--no-browser",
        "--page",
        f"/cell/{LABEL}",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        found = re.search(
            r"view here: http://127\.0\.0\.1:(\d+)(/cell/\S+\?token=\S+)", process.stdout.readline()
        )
        connection = HTTPConnection("127.0.0.1", int(found[1]), timeout=600)
        connection.request("GET", found[2])
        answer = connection.getresponse()
        answer.read()
        cookie = (answer.getheader("set-cookie") or "").partition(";")[0]
        connection.request("GET", answer.getheader("location") or "", headers={"Cookie": cookie})
        assert LABEL in connection.getresponse().read().decode()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=600)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert "Traceback" not in errors
    assert "ssh -L" in errors


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("RESULTS", "--page", "cells"), 2, "places begin with a slash"),
        (("RESULTS", "--open", "cells"), 2, "places begin with a slash"),
        (("/nowhere",), 1, "neither runs nor a store"),
        (("RESULTS", "--episodes", "1"), 2, "go with --bundle"),
        (("RESULTS", "--bundle", "OUT", "--cell", "zzz"), 2, "zzz"),
    ],
)
def test_what_cannot_be_shown_is_said(
    tmp_path: Path, arguments: tuple[str, ...], code: int, expected: str
) -> None:
    places = {"RESULTS": str(brought(tmp_path / "results", LABEL)), "OUT": str(tmp_path / "out")}
    assert (
        expected
        in run_here(
            "view",
            *(places.get(word, word) for word in arguments),
            "--no-browser",
            columns=200,
            code=code,
        ).stderr
    )
