"""A real store that is checked in gives the same report, byte for byte, on every machine and in
every version.

After a wanted change of a table: `WASP_GOLDEN=write pytest tests/report/test_golden_store.py`. How
the store was made: golden_store.py.
"""

import os
import shutil
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.report.golden_store import STORE, report_of
from wasp_cli.cells.asked import asked_of
from wasp_cli.cells.runs import last_runs
from wasp_cli.report.render import RENDERERS
from wasp_cli.report.summarize import Report
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.layout import Layout

EXPECTED = STORE.parent / "report"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy: reports are written into the folder that they read."""
    return shutil.copytree(STORE, tmp_path_factory.mktemp("golden") / "results")


@pytest.fixture(scope="module")
def report(results: Path) -> Report:
    return report_of(results, load_paper())


def texts(report: Report) -> dict[str, str]:
    found = {
        f"{table.name}.{ending}": render(table)
        for table in report.tables
        for ending, render in RENDERERS.items()
    }
    return {**found, "report.md": report.markdown()}


def test_every_table_in_every_format_is_the_same_to_the_byte(report: Report) -> None:
    found = texts(report)
    if os.environ.get("WASP_GOLDEN") == "write":
        shutil.rmtree(EXPECTED, ignore_errors=True)
        EXPECTED.mkdir()
        for name, text in found.items():
            (EXPECTED / name).write_text(text, encoding="utf-8")
    assert found == {path.name: path.read_text(encoding="utf-8") for path in EXPECTED.iterdir()}


def test_the_store_is_whole_and_has_everything_that_a_report_can_show(report: Report) -> None:
    assert not report.missing
    assert not report.damaged
    assert {table.name for table in report.tables} >= {
        "table1",
        "table2",
        "figure3",
        "paper",
        "statistics",
        "severity",
        "latency",
    }
    assert {
        answer.outcome
        for judged in report.verdict.claims
        for answers in judged.answers
        for answer in answers
    } > {"untested"}


@pytest.mark.usefixtures("without_figures")
def test_a_gap_is_named_and_strict_ends_with_1(results: Path, tmp_path: Path) -> None:
    partial = shutil.copytree(results, tmp_path / "results")
    cell = sorted(partial.glob("store/evaluate/*/episodes.parquet"))[0]
    key = cell.parent.name
    shutil.rmtree(cell.parent)
    strict = run_here("report", partial, "--no-trained", "--strict", columns=120, code=1)
    assert "1 of 32 cells is missing" in strict.output
    assert "not computed yet" in strict.output
    asked = asked_of(last_runs(Layout(partial)).runs["golden"])
    (label,) = (one.title for one in asked.cells if one.key == key)
    pages = [
        (partial / "reports" / "golden" / name).read_text(encoding="utf-8")
        for name in ("report.md", "report.html")
    ]
    assert all(f"{label}: not computed yet" in page for page in pages)
    assert label in strict.output.partition("error: golden: 1 of 32 cells is missing:")[2]


@pytest.mark.usefixtures("without_figures")
def test_the_page_has_the_main_table_before_the_verdict_on_the_claims(
    results: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(results, tmp_path / "results")
    run_here("report", folder, "--no-trained", columns=120, code=0)
    page = (folder / "reports" / "golden" / "report.html").read_text(encoding="utf-8")
    assert page.index('id="table1"') < page.index("Of 21 claims")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (None, "no such file"),
        ("claims: [\n", "not valid YAML"),
        ("title: x\ntables: []\nclaims: [{says: x}]\n", "missing key 'id' in 'claims.0'"),
    ],
)
@pytest.mark.usefixtures("without_figures")
def test_a_wrong_paper_is_named_and_is_no_damage_of_the_results(
    results: Path, tmp_path: Path, text: str | None, what: str
) -> None:
    paper = tmp_path / "mine.yaml"
    if text is not None:
        paper.write_text(text)
    done = run_here("report", results, "--no-trained", "--paper", paper, columns=200, code=3)
    assert f"{paper}:" in done.stderr
    assert what in done.stderr
    assert "cannot be read" not in done.stderr
    assert done.stdout == ""


@pytest.mark.usefixtures("without_figures")
def test_a_paper_of_ones_own_is_the_one_that_is_judged(results: Path, tmp_path: Path) -> None:
    paper = tmp_path / "mine.yaml"
    statement = (
        "{tasks: [goal1], left: [human], relation: at_most, columns: [int_rate], bound: 0.5}"
    )
    paper.write_text(
        "title: Mine\ntables: []\nclaims:\n- id: alone\n  section: '1'\n  says: Nobody "
        f"helps\n  statements: [{statement}]\n"
    )
    done = run_here(
        "report",
        results,
        "--no-trained",
        "--strict",
        "--paper",
        paper,
        columns=200,
        code=0,
    )
    assert "The paper's claims: of 1 claim 1 holds" in done.stdout
    assert "Nobody helps" in (results / "reports" / "golden" / "report.md").read_text()
