from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from wasp_cli.drive import server as server_module
from wasp_cli.drive.check import Driver, to_the_goal
from wasp_cli.drive.command import Wanted
from wasp_cli.drive.desk import END, Desk
from wasp_cli.drive.server import Server
from wasp_cli.drive.session import Session
from wasp_cli.store.artifact import sweep
from wasp_cli.store.layout import Layout


def wanted(
    results: Path, method: str | None = "human", speed: float = 4.0, **more: object
) -> Wanted:
    """What `wasp drive goal1` is asked for, with the published models."""
    asked = {
        "what": "goal1",
        "participant": None,
        "episodes": 1,
        "session": None,
        "hide": (),
        "preset": None,
        "settings": (),
        "jobs": 1,
    }
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
        clock.join(300)
        server.stop()


def asking(desk: Desk, requests: dict[int, str]) -> Driver:
    """A driver who asks for something in the middle of an episode, by how many began before it."""
    seen = {"episodes": -1, "t": -1}

    def keys(header: Mapping[str, Any]) -> list[str]:
        seen["episodes"] += header["t"] < seen["t"] or seen["t"] < 0
        seen["t"] = header["t"]
        if header["t"] > 3 and (request := requests.pop(seen["episodes"], None)):
            desk.ask(request)
        return to_the_goal(header)

    return keys


@contextmanager
def swept_before_commit(place: ModuleType) -> Iterator[None]:
    """Another process cleans the results folder while a module writes an artifact: in its last
    moment.
    """
    real = place.commit

    def commit(layout: Layout, *arguments: Any) -> Path:
        sweep(layout)
        made: Path = real(layout, *arguments)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(place, "commit", commit)
        yield


def harmed(layout: Layout, kind: str, key: str) -> Path:
    """Change bytes of the largest file of an artifact, and return it; its size stays."""
    files = layout.artifact(kind, key).glob("[!_]*")
    victim = max(
        files, key=lambda path: (path.suffix in (".safetensors", ".parquet"), path.stat().st_size)
    )
    data = bytearray(victim.read_bytes())
    data[-40:-20] = bytes(byte ^ 0xFF for byte in data[-40:-20])
    victim.write_bytes(data)
    return victim


@pytest.fixture(scope="module", autouse=True)
def patient() -> Iterator[None]:
    """On a busy machine a connection may say nothing for longer than a page ever does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server_module, "SILENT", 600.0)
        yield


@pytest.fixture(scope="module")
def spec(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the SPEC that a test module has."""
    path = tmp_path_factory.mktemp("spec") / "spec.yaml"
    path.write_text(request.module.SPEC)
    return path


@pytest.fixture(scope="session")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with everything that WASP needs on Goal1, brought in from what is
    published.
    """
    folder = tmp_path_factory.mktemp("drive") / "results"
    wanted(folder, "wasp").prepared()
    return folder
