"""The command as a process: it prints one address, answers there, and Ctrl-C ends it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from http.client import HTTPConnection
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.view.conftest import brought
from tests.view.test_walk import HUMAN


def test_it_serves_until_it_is_interrupted(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", HUMAN)
    command = [sys.executable, "-m", "wasp_cli", "view", str(results), "--no-browser", "--open", f"/cell/{HUMAN}"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        found = re.search(r"view here: http://127\.0\.0\.1:(\d+)(/cell/\S+\?token=\S+)", process.stdout.readline())
        connection = HTTPConnection("127.0.0.1", int(found[1]), timeout=300)
        connection.request("GET", found[2])
        answer = connection.getresponse()
        answer.read()
        cookie = (answer.getheader("set-cookie") or "").partition(";")[0]
        connection.request("GET", answer.getheader("location") or "", headers={"Cookie": cookie})
        assert HUMAN in connection.getresponse().read().decode()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=300)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert "Traceback" not in errors
    assert "ssh -L" in errors


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (("RESULTS", "--open", "cells"), 2, "places begin with a slash"), (("/nowhere",), 1, "neither runs nor a store"),
        (("RESULTS", "--episodes", "1"), 2, "go with --bundle"),
        (("RESULTS", "--bundle", "OUT", "--cell", "zzz"), 2, "zzz"),
    ],
)  # fmt: skip
def test_what_cannot_be_shown_is_said(tmp_path: Path, arguments: tuple[str, ...], code: int, expected: str) -> None:
    places = {"RESULTS": str(brought(tmp_path / "results", HUMAN)), "OUT": str(tmp_path / "out")}
    done = run_here("view", *(places.get(word, word) for word in arguments), "--no-browser", columns=200)
    assert (done.exit_code, expected in done.stderr) == (code, True), done.output
