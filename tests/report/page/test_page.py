"""The page as a whole: everything is in it, nothing is fetched, nobody's text becomes markup."""

import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from wasp_cli.report.claims import judge
from wasp_cli.report.figures import cost_return_figure
from wasp_cli.report.stats import Frame, Missing
from wasp_cli.report.summarize import Report
from wasp_cli.report.tables.main import detail_table, main_table
from wasp_cli.report.trained.parts import Trained
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

EVIL = "</script><script>document.title='obeyed'</script><img src=http://evil onerror=alert(1)>"
VOID = {"meta", "img", "input", "br", "line", "rect", "polyline"}
CHROMIUM = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None)


class Outline(HTMLParser):
    """Tags must close in order; anchors and what could be fetched are collected."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        if known.get("id"):
            self.ids.append(known["id"] or "")
        if tag == "a":
            self.links.append(known.get("href") or "")
        self.fetched += [value or "" for name, value in attrs if name in ("src", "srcset", "data", "action", "poster")]

    def handle_endtag(self, tag: str) -> None:
        assert tag not in VOID
        assert self.open.pop() == tag


def page_of(frame: Frame, folder: Path, *, word: str = "plain") -> str:
    missing = Missing(CellIdentity("goal1", "wasp", "full", "noisy", 0.2, 7), f"goal1 wasp {word}", f"failed: {word}")
    report = Report(
        name=word,
        layout=Layout(folder),
        facts=("a fact", "another", f"a third: {word}"),
        tables=(main_table(frame), detail_table(frame)),
        shown=1,
        frame=replace(frame, missing=(missing,)),
        trained=(Trained(f"expert {word}", "goal1", 0, "0123456789", 61.0, {"note": word}),),
        assumptions=(("wasp.tau_c", 0.3, word),),
        verdict=judge(frame, load_paper()),
    )
    return report.html(cost_return_figure(frame, folder))


def test_everything_is_there_and_nothing_is_fetched(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path)
    outline = Outline(page)
    assert outline.open == []
    assert {link.removeprefix("#") for link in outline.links} == {"results", "trained", "assumptions"}
    assert set(outline.ids) >= {"results", "trained", "assumptions", "table1", "details", "figure-cost_return"}
    assert len(set(outline.ids)) == len(outline.ids)
    assert outline.fetched
    assert all(source.startswith("data:image/") for source in outline.fetched)
    assert not re.search(r"@import|url\((?!data:)|<link|<iframe|https?://(?!www\.w3\.org)", page)
    missing = f"1 of {len(frame.cells) + 1} cells is missing"
    for text in ('<section class="verdict">', "SafeRL-Res", missing, "wasp.tau_c", "1 min 01 s"):
        assert text in page
    assert page.index('id="table1"') < page.index('<section class="verdict">')


def test_no_text_becomes_markup(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path, word=EVIL)
    outline = Outline(page)
    assert page.count("<script>") == 1
    assert "<img src=http" not in page
    assert all(source.startswith("data:image/") for source in outline.fetched)


def test_an_empty_report_is_a_page(tmp_path: Path) -> None:
    report = Report("empty", Layout(tmp_path), facts=(), tables=(), shown=0, frame=Frame(()), trained=(), assumptions=())
    page = report.html()
    assert Outline(page).open == []


PROBE = """<script>
  const told = [];
  const numbers = () => Array.from(document.querySelectorAll('#table1 tbody:first-of-type tr'), (row) => row.cells[2].dataset.value);
  document.querySelectorAll('#table1 th button')[2].click();
  const falling = numbers().filter(Boolean).map(Number);
  told.push(falling.length > 3 && falling.every((x, i) => i === 0 || falling[i - 1] >= x));
  document.querySelectorAll('#table1 th button')[2].click();
  const rising = numbers().filter(Boolean).map(Number);
  told.push(rising.length > 3 && rising.every((x, i) => i === 0 || rising[i - 1] <= x));
  const texts = () => Array.from(document.querySelectorAll('#table1 tbody:first-of-type tr'), (row) => row.cells[1].textContent.trim());
  document.querySelectorAll('#table1 th button')[1].click();
  told.push(texts().length > 3 && texts().every((x, i) => i === 0 || texts()[i - 1].localeCompare(x) <= 0));
  told.push(getComputedStyle(document.getElementById('trained')).display === 'none');
  location.hash = '#trained';
  window.addEventListener('hashchange', () => {
    told.push(getComputedStyle(document.getElementById('trained')).display === 'block');
    document.title = 'told ' + told.join(' ');
  });
</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_browser_sorts_turns_pages_and_complains_of_nothing(frame: Frame, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    page = tmp_path / "page.html"
    page.write_text(page_of(frame, tmp_path, word=EVIL).replace("</body>", PROBE), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [CHROMIUM, *options, "--virtual-time-budget=3000", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    title = re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title[1] == "told true true true true true"
    assert ":CONSOLE" not in done.stderr
