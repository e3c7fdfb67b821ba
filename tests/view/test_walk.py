"""A real Chromium walks from the table of cells to a decision and back, and asks nobody else
for anything.
"""

from pathlib import Path

import pytest

from tests.drive.browser import Browser
from tests.view.conftest import brought, viewed

WASP, HUMAN = "goal1 s1 wasp noisy=0.45", "goal1 s1 human noisy=0.45"
BRANCHED = "race1 s1 wasp laggy=0.7"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brought(tmp_path_factory.mktemp("view") / "results", WASP, HUMAN, BRANCHED)


def press(tab: object, key: str) -> None:
    tab.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=key)  # type: ignore[attr-defined]
    tab.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=key)  # type: ignore[attr-defined]


def test_from_the_table_to_a_step_and_back(browser: Browser, results: Path) -> None:
    with viewed(results) as server:
        tab = browser.tab()
        tab.size(1280, 900)
        tab.open(server.opening("/cells"))
        assert "token" not in tab.value("location.href"), (
            "the address can be sent without giving the token away"
        )
        shown = "[...document.querySelectorAll('#cells tbody tr')].filter(row => !row.hidden)"
        assert tab.value(f"{shown}.length") == 3
        tab.until(
            "[...document.querySelectorAll('#cells tbody tr')].every(row => "
            "row.cells[6].textContent)"
        )

        # The first press on a heading sorts numbers down and texts up, as in reports; the second
        # turns it.
        column = (
            "[...document.querySelectorAll('#cells tbody tr')].map(row => "
            "row.cells[{}].textContent)"
        )
        for place, down in ((6, True), (0, False)):
            for reverse in (down, not down):
                tab.value(f"document.querySelectorAll('#cells thead button')[{place}].click()")
                texts = tab.value(column.format(place))
                assert texts == sorted(texts, key=float if down else None, reverse=reverse)

        # A filter stands in the address, and another tab that opens it has it too.
        choose = (
            "document.querySelector('[name={}]').value = '{}'; "
            "document.querySelector('#filters').dispatchEvent(new Event('input'))"
        )
        for name, value in (("method", "WASP"), ("task", "goal1")):
            tab.value(choose.format(name, value))
        assert tab.value(f"{shown}.length") == 1
        assert "1 of 3 cells" in tab.value("document.querySelector('#counted').textContent")
        tab.open(tab.value("location.href"))
        assert tab.value(f"{shown}.length") == 1

        tab.value(f"{shown}[0].querySelector('a').click()")
        tab.until("location.pathname.startsWith('/cell/') && document.readyState === 'complete'")
        assert WASP in tab.value("document.querySelector('h1').textContent")
        tab.value("document.querySelector('table.sortable a').click()")
        tab.until("location.pathname.endsWith('/episode/0') && document.readyState === 'complete'")

        # The film comes by itself, and every key moves film, timeline and explanation together.
        tab.until("document.querySelector('.screen img').naturalWidth > 0")
        assert tab.value("document.querySelectorAll('ul.legend li').length") >= 6
        assert "what the robot's own cameras see" in tab.value(
            "document.querySelector('.film-of').innerText"
        )
        said = "document.querySelector('.step').innerText"
        for key, step in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1)):
            press(tab, key)
            tab.until(f"document.querySelector('.step').dataset.shown === '{step}'")
            assert f"decision {step} " in tab.value(said)
            assert f"decision {step} of 0 to " in tab.value(
                "document.querySelector('.scrubber output, output').textContent"
            )
            assert tab.value("location.search") == f"?step={step}"
            assert tab.value("document.querySelector('.cursor').getAttribute('x1')") == str(
                step + 0.5
            )
        stops = tab.value("JSON.parse(document.querySelector('section.episode').dataset.stops)")
        expected = next(stop for stop in stops if stop > 1)
        press(tab, "n")
        tab.until(f"document.querySelector('.step').dataset.shown === '{expected}'")
        press(tab, "n")
        press(tab, "p")
        tab.until(f"document.querySelector('.step').dataset.shown === '{expected}'")

        # The address of this decision opens it.
        tab.open(tab.value("location.href"))
        tab.until(f"document.querySelector('.step').dataset.shown === '{expected}'")
        assert f"decision {expected} " in tab.value(said)

        press(tab, "Escape")
        tab.until("!location.pathname.includes('/episode/') && document.readyState === 'complete'")
        press(tab, "Escape")
        tab.until("location.pathname === '/cells' && document.readyState === 'complete'")
        asked = tab.requests()
        tab.close()
        port = server.port
    assert all(url.startswith((f"http://127.0.0.1:{port}/", "data:")) for url in asked), asked


def test_pages_fit_a_narrow_window(browser: Browser, results: Path) -> None:
    with viewed(results) as server:
        tab = browser.tab()
        tab.size(500, 900)
        for place in ("/", "/cells", f"/cell/{WASP}", f"/cell/{WASP}/episode/0?step=20"):
            tab.open(server.opening(place))
            assert tab.value("document.documentElement.scrollWidth") <= 500, place
        edge = (
            "Math.max(...[...document.querySelectorAll('pre.explain span')].map(span => "
            "span.getBoundingClientRect().right))"
        )
        assert tab.value(edge) <= 500, "what explains a decision is not cut either"
        tab.close()


def test_of_many_rows_the_first_are_laid_out_and_all_are_found(
    browser: Browser, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("wasp_cli.view.pages.FIRST", 1)
    with viewed(results) as server:
        tab = browser.tab()
        tab.size(1280, 120)  # what follows the table is out of sight
        tab.open(server.opening("/cells"))
        shown = (
            "[...document.querySelectorAll('#cells tbody tr')].filter(row => "
            "!row.hidden).map(row => row.cells[0].textContent)"
        )
        assert len(tab.value(shown)) == 1
        assert tab.value("document.querySelector('#counted').textContent") == "3 cells"
        typed = (
            "document.querySelector('[name=text]').value = '{}'; "
            "document.querySelector('#filters').dispatchEvent(new Event('input'))"
        )
        tab.value(typed.format("race1 wasp"))
        assert tab.value(shown) == ["race1"], "a row that was not laid out is found"
        tab.value(typed.format(""))
        tab.value("document.querySelector('#cells thead button').click()")
        tab.value("document.querySelector('#cells thead button').click()")
        assert tab.value(shown) == ["race1"], "the greatest of all, not of those shown"
        tab.value("document.querySelector('#more button').click()")
        tab.until(f"{shown}.length === 2")
        tab.value("window.scrollTo(0, 1e6)")
        tab.until(f"{shown}.length === 3")
        tab.close()
