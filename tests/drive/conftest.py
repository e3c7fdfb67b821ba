from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from wasp_cli.drive.command import Wanted
from wasp_cli.drive.desk import END, Desk
from wasp_cli.drive.server import Server
from wasp_cli.drive.session import Session


def wanted(results: Path, method: str = "human", speed: float = 4.0, **more: object) -> Wanted:
    """What `wasp drive goal1` is asked for, with the published models."""
    asked = {"what": "goal1", "participant": None, "episodes": 1, "session": None, "hide": (), "preset": None, "settings": (), "jobs": 1}
    return Wanted(method=method, speed=speed, results=results, **{**asked, **more})  # type: ignore[arg-type]


@contextmanager
def served(session: Session) -> Iterator[tuple[Desk, Server, threading.Thread]]:
    """A session that is led in a thread, and its server."""
    desk = Desk()
    server = Server(desk)
    server.start()
    clock = threading.Thread(target=session.run, args=(desk,), daemon=True)
    clock.start()
    try:
        yield desk, server, clock
    finally:
        desk.ask(END)
        clock.join(30)
        server.stop()


@pytest.fixture(scope="session")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with everything that WASP needs on Goal1, brought in from what is published."""
    folder = tmp_path_factory.mktemp("drive") / "results"
    wanted(folder, "wasp").prepared()
    return folder
