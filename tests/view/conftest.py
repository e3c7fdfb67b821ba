import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.drive.browser import CHROMIUM, Browser, chromium
from wasp_cli.view.server import ViewServer
from wasp_cli.view.site import site_of

PUBLISHED = Path(__file__).parents[2] / "results" / "published"


@contextmanager
def viewed(folder: Path) -> Iterator[ViewServer]:
    """The server of a results folder."""
    server = ViewServer(site_of(folder))
    server.start()
    try:
        yield server
    finally:
        server.stop()


def brought(folder: Path, *labels: str) -> Path:
    """A results folder with published cells, by their labels, and their branches."""
    keys = {label: published_cells()[label] for label in labels}
    for key in keys.values():
        shutil.copytree(PUBLISHED / "store" / "evaluate" / key, folder / "store" / "evaluate" / key)
    for key in filter(None, map(published_branches().get, keys.values())):
        shutil.copytree(
            PUBLISHED / "store" / "counterfactual" / key, folder / "store" / "counterfactual" / key
        )
    return folder


def published(kind: str) -> list[dict[str, Any]]:
    return [
        json.loads(path.read_text(encoding="utf-8"))
        for path in sorted((PUBLISHED / "store" / kind).glob("*/_manifest.json"))
    ]


@cache
def published_cells() -> dict[str, str]:
    """Keys of cells by label; of several editions the oldest, since its later episodes have
    their steps.
    """
    newest_first = sorted(
        published("evaluate"),
        key=lambda manifest: manifest["provenance"]["started_at"],
        reverse=True,
    )
    return {manifest["label"]: manifest["key"] for manifest in newest_first}


@cache
def published_branches() -> dict[str, str]:  # by the key of their cell
    return {
        manifest["upstream"]["evaluate"]: manifest["key"]
        for manifest in published("counterfactual")
    }


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running
