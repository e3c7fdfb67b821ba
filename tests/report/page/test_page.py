"""The page as a whole: everything is in it, nothing is fetched, nobody's text becomes markup."""

import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.report.explained import Invented
from tests.report.made import NO_CELLS
from tests.report.markup import Outline
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import Missing
from wasp_cli.metrics.episode import (
    GATE_METHOD,
    GATE_SAFETY,
    GATE_TASK,
)
from wasp_cli.report.claims import judge
from wasp_cli.report.explain.episode import Episode
from wasp_cli.report.explain.timeline import CURVE, timeline
from wasp_cli.report.figures import cost_return_figure
from wasp_cli.report.render import rendered
from wasp_cli.report.stats import Frame
from wasp_cli.report.summarize import Report
from wasp_cli.report.tables.main import main_table
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import Thresholds

EVIL = "</script><script>document.title='obeyed'</script><img src=http://evil onerror=alert(1)>"
FETCHED = ("src", "srcset", "data", "action", "poster")
CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    None,
)


def page_of(frame: Frame, folder: Path, *, word: str = "plain") -> str:
    lost = RecordedCell("goal1", "wasp", "full", "noisy", 0.2, 7)
    missing = Missing(lost, f"failed: {word}", f"goal1 wasp {word}")
    report = Report(
        name=word,
        layout=Layout(folder),
        facts=("a fact", "another", f"a third: {word}"),
        shown=(main_table(frame),),
        frame=replace(frame, missing=(missing,)),
        trained=(Trained(f"expert {word}", "goal1", 0, "0123456789", 61.0, {"note": word}),),
        assumptions=(("wasp.tau_c", 0.3, word),),
        judging=partial(judge, frame, load_paper()),
    )
    return report.html(cost_return_figure(frame, folder))


def test_everything_is_there_and_nothing_is_fetched(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path)
    outline = Outline(page)
    ids, fetched = outline.values("id"), outline.values(*FETCHED)
    assert {str(link["href"]).removeprefix("#") for link in outline.all("a")} == {
        "results",
        "trained",
        "assumptions",
    }
    assert set(ids) >= {
        "results",
        "trained",
        "assumptions",
        "table1",
        "details",
        "figure-cost_return",
    }
    assert len(set(ids)) == len(ids)
    assert fetched
    assert all(source.startswith("data:image/") for source in fetched)
    assert not re.search(r"@import|url\((?!data:)|<link|<iframe|https?://(?!www\.w3\.org)", page)
    missing = f"1 of {len(frame.cells) + 1} cells is missing"
    for text in ('<section class="verdict">', "SafeRL-Res", missing, "wasp.tau_c", "1 min 01 s"):
        assert text in page
    assert page.index('id="table1"') < page.index('<section class="verdict">')


def test_no_text_becomes_markup(frame: Frame, tmp_path: Path) -> None:
    page = page_of(frame, tmp_path, word=EVIL)
    assert page.count("<script>") == 1
    assert "<img src=http" not in page
    assert all(source.startswith("data:image/") for source in Outline(page).values(*FETCHED))


def test_an_empty_report_is_a_page(tmp_path: Path) -> None:
    report = Report(
        "empty",
        Layout(tmp_path),
        facts=(),
        shown=(),
        frame=Frame(NO_CELLS),
        trained=(),
        assumptions=(),
    )
    assert Outline(report.html()).found


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
    options = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}",
    ]
    command = [CHROMIUM, *options, "--virtual-time-budget=3000", "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    title = re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)
    assert title[1] == "told true true true true true"
    assert ":CONSOLE" not in done.stderr


# What a timeline draws: each gate's curve against its threshold, what was done, what it cost.


def lanes(episode: Episode) -> dict[str, str]:
    drawn = rendered("timeline.html", lanes=timeline(episode), decisions=episode.decisions)
    return dict(re.findall(r'<div class="lane"><span>(.*?)</span>(<svg.*?</svg>)</div>', drawn))


def marks(svg: str) -> list[tuple[str, int, int]]:
    return [
        (kind, int(x), int(width))
        for kind, x, width in re.findall(r'<rect class="(\w+)" x="(\d+)" y="0" width="(\d+)"', svg)
    ]


def heights(svg: str) -> list[tuple[float, float]]:
    """Of every decision with a value: its place and its height from above."""
    found = [points.split() for points in re.findall(r'points="(.*?)"', svg)]
    return [
        (float(point.split(",")[0]), float(point.split(",")[1]))
        for line in found
        for point in line[::2]
    ]


def test_gates_interventions_and_costs(tmp_path: Path) -> None:
    it = Invented()
    it.fire(2, GATE_SAFETY)
    it.fire(3, GATE_SAFETY)
    it.fire(5, GATE_TASK)
    it.pay(0, 6, 7)
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["Ḡᶜ", "ΔG", "acts", "cost"]
    assert marks(drawn["acts"]) == [("safety", 2, 2), ("task", 5, 1)]
    assert marks(drawn["cost"]) == [("cost", 0, 1), ("cost", 6, 2)]
    assert all(
        'viewBox="0 0 8 ' in svg and svg.count('class="cursor"') == 1 for svg in drawn.values()
    )


def test_a_curve_is_above_its_threshold_exactly_where_the_gate_fired(tmp_path: Path) -> None:
    it = Invented()
    it.fire(4, GATE_SAFETY)
    svg = lanes(it.read(tmp_path))["Ḡᶜ"]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', svg)
    assert [t for t, y in heights(svg) if y < float(limit)] == [4]
    assert all(0 <= y <= CURVE for _, y in heights(svg))


def test_other_methods_show_their_own_signal(tmp_path: Path) -> None:
    it = Invented(method="ida", thresholds=Thresholds(tau_q=0.1), config={"vote": 0.5})
    it.signal = np.linspace(-1, 1, it.steps)
    it.gate[6:] = GATE_METHOD
    it.a[6:] += 0.25
    drawn = lanes(it.read(tmp_path))
    assert list(drawn) == ["vote", "acts", "cost"]
    assert marks(drawn["acts"]) == [("method", 6, 2)]
    (limit,) = re.findall(r'class="limit" x1="0" x2="8" y1="([\d.]+)"', drawn["vote"])
    # It takes over above a share of the votes; tau_Q is the margin of each vote.
    assert [t for t, y in heights(drawn["vote"]) if y < float(limit)] == [6, 7]
