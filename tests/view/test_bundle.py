"""The pages as a folder: from file:// a real Chromium walks to a step and back, and asks nobody
for anything.
"""

import re
from pathlib import Path
from urllib.parse import unquote

import pytest

from tests.commands import run_here
from tests.drive.browser import Browser
from tests.view.conftest import brought
from tests.view.test_walk import BRANCHED, HUMAN, press
from wasp_cli.store.tables import cell_file, read_episodes

STEPLESS = "race1 s1 wasp laggy=0.85"
"""Published without any steps, so that no film is drawn."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Results of two cells, and a bundle with the first episode of one."""
    folder = tmp_path_factory.mktemp("bundle")
    results = brought(folder / "results", BRANCHED, HUMAN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wasp_cli.view.server.FRAMES", 25)
        done = run_here(
            "view",
            results,
            "--bundle",
            folder / "pages",
            "--cell",
            BRANCHED,
            "--episodes",
            "0,1",
            columns=200,
        )
    assert done.exit_code == 0, done.output
    assert "2 cells, 1 episodes, 1 films" in done.stdout
    assert "the steps of episode 1 are not here" in done.stderr
    return results, folder / "pages"


def test_reports_are_linked_beside_the_bundle_and_never_copied_into_it(tmp_path: Path) -> None:
    results = brought(tmp_path / "results", STEPLESS)
    report = results / "reports" / "table 1" / "report.html"
    report.parent.mkdir(parents=True)
    report.write_text("a report<script>window.owned=1</script>")
    for folder in (results / "pages", tmp_path / "pages"):
        done = run_here(
            "view",
            results,
            "--bundle",
            folder,
            "--cell",
            STEPLESS,
            "--episodes",
            "0",
            columns=200,
            code=0,
        )
        assert "the steps of episode 0 are not here" in done.stderr
        index = (folder / "index.html").read_text()
        href = re.search(r'<a href="([^"]+)">report.html</a>', index)
        assert (href is not None) == folder.is_relative_to(results)
        assert href is None or (folder / unquote(href[1])).samefile(report)
        assert "report.html" in index, "its name is there"
        assert not [path for path in folder.rglob("*.html") if "window.owned" in path.read_text()]


def test_a_browser_walks_through_files(browser: Browser, made: tuple[Path, Path]) -> None:
    _, pages = made
    tab = browser.tab()
    tab.size(1280, 900)
    tab.open((pages / "index.html").as_uri())
    assert tab.value("getComputedStyle(document.querySelector('nav.top')).display") == "flex", (
        "its style is there"
    )
    tab.value("[...document.querySelectorAll('a')].find(a => a.textContent === '2 cells').click()")
    tab.until("location.pathname.endsWith('/cells.html') && document.readyState === 'complete'")
    tab.value(
        "document.querySelector('[name=task]').value = 'race1'; "
        "document.querySelector('#filters').dispatchEvent(new Event('input'))"
    )
    assert (
        tab.value(
            "[...document.querySelectorAll('#cells tbody tr')].filter(row => !row.hidden).length"
        )
        == 1
    )
    tab.value(
        "[...document.querySelectorAll('#cells tbody tr')].find(row => "
        "!row.hidden).querySelector('a').click()"
    )
    tab.until("location.pathname.includes('/cell-') && document.readyState === 'complete'")
    assert tab.value("document.querySelectorAll('table.sortable tbody a').length") == 1, (
        "only what is here has a link"
    )
    tab.value("document.querySelector('table.sortable tbody a').click()")
    tab.until("location.pathname.includes('/episode-') && document.readyState === 'complete'")
    tab.until("document.querySelector('.screen img').naturalWidth > 0")
    assert tab.value("document.querySelectorAll('ul.legend li').length") >= 6
    for step in (1, 2):
        press(tab, "ArrowRight")
        tab.until(f"document.querySelector('.step').dataset.shown === '{step}'")
        assert f"decision {step} " in tab.value("document.querySelector('.step').innerText")
    first = tab.value("document.querySelector('.screen img').src")
    for _ in range(12):
        press(tab, "ArrowRight")
    tab.until(
        f"document.querySelector('.screen img').src !== {first!r} && "
        "document.querySelector('.screen img').naturalWidth > 0"
    )
    branched = tab.value("JSON.parse(document.querySelector('section.episode').dataset.branched)")
    address = tab.value("location.href.split('?')[0]")
    tab.open(f"{address}?step={branched[0]}")
    tab.until(f"document.querySelector('.step').dataset.shown === '{branched[0]}'")
    said = tab.value("document.querySelector('.pair').innerText")
    assert all(words in said for words in ("as executed", "command alone", "ρ"))
    assert tab.value("document.querySelectorAll('.pair svg.boxes').length") == 2, (
        "both branches stand beside each other"
    )
    press(tab, "Escape")
    tab.until("location.pathname.includes('/cell-') && document.readyState === 'complete'")
    press(tab, "Escape")
    tab.until("location.pathname.endsWith('/cells.html') && document.readyState === 'complete'")
    asked = tab.requests()
    tab.close()
    assert all(url.startswith(("file://", "data:")) for url in asked), asked


def test_it_has_no_way_to_change_anything_and_tells_nothing_of_the_machine(
    made: tuple[Path, Path],
) -> None:
    results, pages = made
    texts = {path.name: path.read_text(encoding="utf-8") for path in pages.glob("*.html")}
    assert len(texts) == 5
    for name, text in texts.items():
        assert "<form method" not in text, name
        assert "default-src 'none'" in text, name
        assert str(results.parent) not in text, name
        for link in re.findall(r'(?:href|src)="([^"]*)"', text):
            assert (pages / link.partition("?")[0]).is_file(), (name, link)


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    results, mine, pages = (
        brought(tmp_path / "results", STEPLESS),
        tmp_path / "mine",
        tmp_path / "pages",
    )
    mine.mkdir()
    (mine / "mine.txt").write_text("mine")
    assert (
        "holds something else"
        in run_here("view", results, "--bundle", mine, columns=200, code=2).stderr
    )
    assert [path.name for path in mine.iterdir()] == ["mine.txt"]
    written = []
    for _ in range(2):
        assert (
            run_here("view", results, "--bundle", pages, "--cell", STEPLESS, columns=200).exit_code
            == 0
        ), "its own is written again"
        written.append({path.name for path in pages.iterdir()})
    assert written[0] == written[1] != set()
    for more in (("--episodes", "x"), ("--port", "5"), ("--page", "/cells")):
        assert (
            run_here("view", results, "--bundle", tmp_path / "new", *more, columns=200).exit_code
            == 2
        )
    (rows,) = (results / "store" / "evaluate").glob("*/episodes.parquet")
    rows.write_bytes(rows.read_bytes()[:500])
    assert run_here("view", results, "--bundle", pages, columns=200).exit_code == 0
    texts = [path.read_text(encoding="utf-8") for path in pages.glob("*.html")]
    assert any("episodes.parquet is damaged" in text for text in texts)
    assert not any(str(tmp_path) in text for text in texts), "a bundle is for others"


def test_every_cell_has_a_page_with_the_return_of_its_rows(made: tuple[Path, Path]) -> None:
    results, pages = made
    shown = {
        path.stem.rpartition("-")[2]: path.read_text(encoding="utf-8")
        for path in pages.glob("cell-*.html")
    }
    for cell in (results / "store" / "evaluate").iterdir():
        returns = read_episodes([cell_file(cell)])["return"].to_numpy()
        assert f"{returns.mean():.2f}" in shown[cell.name[:8]]
