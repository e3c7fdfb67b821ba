"""The first page: the main table of each spec, whose numbers lead to their cells, and its
report, which is a stranger to the server.
"""

import re
import shutil
from collections.abc import Iterator
from html import unescape
from pathlib import Path

import pytest

from tests.commands import run_here
from tests.view.conftest import viewed
from tests.view.test_server import ask
from wasp_cli.notebook import open_results
from wasp_cli.view.pages import main_tables
from wasp_cli.view.server import ViewServer
from wasp_cli.view.site import site_of

SPEC = "extends: field\nname: part\ntasks: [goal1]\nmethods: [human, ida, wasp]\nseeds: [313]\n"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of published cells: nothing is computed."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "part.yaml").write_text(SPEC, encoding="utf-8")
    done = run_here(
        "run", folder / "part.yaml", "--results", folder / "results", "-j", "0", columns=200, code=0
    )
    assert "with WASP" in done.stdout
    assert "next: wasp view" in done.stderr
    return folder / "results"


@pytest.fixture(scope="module")
def server(results: Path) -> Iterator[ViewServer]:
    with viewed(results) as running:
        yield running


def test_numbers_of_the_main_table_lead_to_their_cells(server: ViewServer, results: Path) -> None:
    _, _, page = ask(server, "/")
    assert "Goal1: the operators alone return" in page
    linked = re.findall(r'<a href="(/cells[^"]*)">(?:<strong>)?([\d.]+)', page)
    (row,) = [row for row in open_results(results).table().to_pylist() if row["method"] == "WASP"]
    of_wasp = [text for place, text in linked if unescape(place) == "/cells?task=goal1&method=WASP"]
    assert of_wasp[:3] == [
        f"{row['return']:.2f}",
        f"{100 * row['success']:.1f}",
        f"{row['cost']:.2f}",
    ]
    assert ask(server, "/cells?task=goal1&method=WASP")[2].count(">WASP</a>") == 4


def test_a_newer_spec_takes_no_cells_from_the_table_of_an_older_one(
    results: Path, tmp_path: Path
) -> None:
    shutil.copytree(results, tmp_path / "results")
    newer = (
        SPEC.replace("name: part", "name: newer")
        + "operators: {noisy: null, limited-skill: null, reaction-time: null}\n"
    )
    (tmp_path / "newer.yaml").write_text(newer, encoding="utf-8")
    run_here(
        "run",
        tmp_path / "newer.yaml",
        "--results",
        tmp_path / "results",
        "-j",
        "0",
        columns=200,
        code=0,
    )
    before, (newest, older) = (
        next(main_tables(site_of(results))),
        main_tables(site_of(tmp_path / "results")),
    )
    assert (newest["spec"], older["spec"]) == ("newer", "part")
    assert [row.values for row in older["table"].rows] == [
        row.values for row in before["table"].rows
    ]


def test_a_run_that_has_just_begun_breaks_no_page(results: Path, tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    site = site_of(tmp_path)
    assert site.cells.listed() == [], "which is asked again after some seconds alone"
    shutil.copytree(results, tmp_path, dirs_exist_ok=True)
    assert [table["spec"] for table in main_tables(site)] == ["part"]


def test_the_report_is_shown_as_a_stranger(server: ViewServer, results: Path) -> None:
    assert 'href="/report/part"' in ask(server, "/")[2]
    status, headers, page = ask(server, "/report/part")
    assert (status, "Report: part" in page) == (200, True)
    policy = headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;")
    assert "same-origin" not in policy
    assert "default-src 'none'" in policy
    assert ask(server, "/report/part", known=False)[0] == 403
    for place in ("/report/none", "/report/..%2f..%2fstore", "/report/%2e%2e"):
        assert ask(server, place)[0] in (404, 409)
    kept = (results / "reports/part/report.html").rename(results / "kept.html")
    (results / "reports/part/report.html").symlink_to(kept)
    assert ask(server, "/report/part")[0] in (404, 409)
