import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    import json

    manifests = [json.loads(path.read_text(encoding="utf-8")) for path in (PUBLISHED / "store" / "evaluate").glob("*/_manifest.json")]
    keys = {}
    # Of several editions the oldest, since its later episodes have their steps.
    for manifest in sorted(manifests, key=lambda manifest: manifest["provenance"]["started_at"], reverse=True):
        if manifest["label"] in labels:
            keys[manifest["label"]] = manifest["key"]
    for key in keys.values():
        shutil.copytree(PUBLISHED / "store" / "evaluate" / key, folder / "store" / "evaluate" / key)
    for path in sorted((PUBLISHED / "store" / "counterfactual").glob("*/_manifest.json")):
        if json.loads(path.read_text(encoding="utf-8"))["upstream"]["evaluate"] in keys.values():
            shutil.copytree(path.parent, folder / "store" / "counterfactual" / path.parent.name)
    assert set(keys) == set(labels)
    return folder


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    with chromium(tmp_path_factory.mktemp("chromium")) as running:
        yield running
