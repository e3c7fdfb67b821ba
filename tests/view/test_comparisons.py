"""Two cells beside each other: where do they differ first?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from tests.drive.browser import Browser
from tests.view.conftest import brought, viewed
from tests.view.test_server import ask
from tests.view.test_walk import HUMAN, WASP
from wasp_cli.report.explain.stored import read_episode
from wasp_cli.store.find import find_cell
from wasp_cli.store.layout import Layout
from wasp_cli.view.pages import first_difference


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brought(tmp_path_factory.mktemp("view") / "results", WASP, HUMAN)


def test_the_page_says_where_two_cells_differ(results: Path) -> None:
    layout = Layout(results)
    wasp, human = (read_episode(find_cell(layout, label), 0) for label in (WASP, HUMAN))
    place = f"/compare/cells?a={quote(WASP)}&b={quote(HUMAN)}"
    with viewed(results) as server:
        _, _, body = ask(server, place)
        assert "<h2>30 worlds that both met</h2>" in body
        _, _, body = ask(server, f"{place}&world={wasp.row['episode_seed']}")
        assert f"Decision {first_difference(wasp, human)} is the first that differs." in body
        _, _, body = ask(server, f"/compare/cells?a={quote(WASP)}&b={quote(WASP)}&world={wasp.row['episode_seed']}")
        assert "Both are the same, decision by decision." in body
        for wrong in ("", f"?a={quote(WASP)}", f"?a={quote(WASP)}&b=zzz", f"?a={quote(WASP)}&b={quote(HUMAN)}&world=1"):
            assert ask(server, f"/compare/cells{wrong}")[0] == 404


def test_rewards_alone_may_differ(results: Path) -> None:
    episode = read_episode(find_cell(Layout(results), WASP), 0)
    rewards = episode.numbers["reward"].copy()
    rewards[7] += 1.0
    assert first_difference(episode, episode) is None
    assert first_difference(episode, replace(episode, numbers={**episode.numbers, "reward": rewards})) == 7


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
        # The page that is left stands at this step already: what comes next is for the one that is opened.
        tab.value("window.left = true; document.querySelector('#differs').click()")
        tab.until(f"window.left === undefined && location.search.includes('step={first}') && document.readyState === 'complete'")
        tab.until(f"[...document.querySelectorAll('.step')].every(part => part.dataset.shown === '{first}')")
        # One scrubber moves both.
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowRight", code="ArrowRight")
        tab.until(f"[...document.querySelectorAll('.step')].every(part => part.dataset.shown === '{first + 1}')")
        tab.until("[...document.querySelectorAll('.screen img')].every(image => image.naturalWidth > 0)", 30)
        tab.close()
