"""Two cells beside each other, and two folders: where do they differ first?"""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.drive.browser import Browser
from tests.store.untrusted import LABEL, UntrustedStore
from tests.view.conftest import brought, viewed
from tests.view.test_server import ask
from tests.view.test_walk import HUMAN, WASP
from wasp_cli.report.explain.stored import read_episode
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.tables import STEPS_FILE


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brought(tmp_path_factory.mktemp("view") / "results", WASP, HUMAN)


def test_two_cells_on_the_same_world(browser: Browser, results: Path) -> None:
    layout = Layout(results)
    wasp, human = (read_episode(find_cell(layout, label), 0) for label in (WASP, HUMAN))
    world = wasp.row["episode_seed"]
    assert human.row["episode_seed"] == world
    # Both are driven alike until WASP corrects for the first time.
    first = int(np.flatnonzero((wasp.a != human.a).any(1))[0])
    with viewed(results) as server:
        tab = browser.tab()
        tab.open(server.opening(f"/compare/cells?a={quote(WASP)}&b={quote(HUMAN)}"))
        tab.value(f"[...document.querySelectorAll('td a')].find(a => a.textContent === '{world}').click()")
        tab.until("document.querySelectorAll('section.episode').length === 2 && document.readyState === 'complete'")
        assert tab.value("document.querySelector('#differs').textContent").startswith(f"Decision {first} ")
        tab.value("document.querySelector('#differs').click()")
        tab.until(f"location.search.includes('step={first}') && document.readyState === 'complete'")
        tab.until(f"[...document.querySelectorAll('.step')].every(part => part.dataset.shown === '{first}')")
        # One scrubber moves both.
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", code="ArrowRight")
        tab.until(f"[...document.querySelectorAll('.step')].every(part => part.dataset.shown === '{first + 1}')")
        tab.until("[...document.querySelectorAll('.screen img')].every(image => image.naturalWidth > 0)", 30)
        tab.close()


def test_two_folders_with_links_to_the_cells_that_differ(tmp_path: Path) -> None:
    first, second = UntrustedStore(tmp_path / "a"), UntrustedStore(tmp_path / "b")
    path = second.layout.artifact("evaluate", second.key) / STEPS_FILE
    steps = pq.read_table(path)
    rewards = steps["reward"].to_pylist()
    rewards[7] += 1.0
    place = steps.schema.get_field_index("reward")
    write_table(
        steps.set_column(place, steps.schema.field("reward"), pa.chunked_array([rewards], pa.float32())).replace_schema_metadata(
            steps.schema.metadata
        ),
        path,
    )
    with viewed(first.layout.root, second.layout.root) as server:
        _, _, body = ask(server, "/compare/stores")
        link = f"/compare/cells?a={first.key}&amp;b=with%3A{second.key}"
        assert link in body
        _, _, body = ask(server, link.replace("&amp;", "&"))
        assert LABEL in body
        _, _, body = ask(server, link.replace("&amp;", "&") + "&world=100")
        assert "Decision 7 is the first that differs." in body
        assert ask(server, "/with/cells")[0] == 200
        assert ask(server, f"/with/cell/{second.key}")[0] == 200
    with viewed(first.layout.root) as server:
        assert ask(server, "/compare/stores")[0] == 404
        assert ask(server, "/with/cells")[0] == 404
        assert ask(server, f"/compare/cells?a={first.key}&b=with:{first.key}")[0] == 404
