"""A report of the same numbers draws nothing; a changed number, figure or trained part has it drawn again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from wasp_cli.report import document
from wasp_cli.report.document import draw_figures
from wasp_cli.report.provenance import last_runs
from wasp_cli.report.stats.frame import Frame
from wasp_cli.report.summarize import report_run
from wasp_cli.run.record import read_run
from wasp_cli.store.layout import Layout

GOLDEN = Path(__file__).parents[2] / "golden" / "store"


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[list[str], bool]]:
    """Reports on a copy of the golden run: the names of the figures, and whether they were drawn."""
    layout = Layout(Path(shutil.copytree(GOLDEN, tmp_path / "results")))
    folder = tmp_path / "report"
    folder.mkdir()
    calls: list[int] = []

    def draw(frame: Frame, into: Path) -> list[Path]:
        """Stand for all figures: what is tested is when they are drawn."""
        calls.append(1)
        files = [into / "cost_return.png", into / "cost_return.svg"]
        for path in files:
            path.write_text(str(len(frame.cells)))
        return files

    monkeypatch.setattr(document, "cost_return_figure", draw)
    for name in ("necessity_figure", "severity_figure", "profile_figure", "latency_figure", "learning_figure", "reliability_figure"):
        monkeypatch.setattr(document, name, lambda *arguments: [])

    def report() -> tuple[list[str], bool]:
        calls.clear()
        run = read_run(layout, last_runs(layout)[0]["golden"])
        found = report_run(layout.root, run.spec, run.cells, run.parts, None, run.branched)
        files = draw_figures(layout, found.frame, found.trained, folder)
        assert all(path.is_file() for path in files)
        return [path.name for path in files], bool(calls)

    return report


def test_the_same_numbers_are_drawn_once(drawn: Callable[[], tuple[list[str], bool]], tmp_path: Path) -> None:
    first, now = drawn()
    assert now
    assert "cost_return.png" in first
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "report").glob("*.png")}
    assert drawn() == (first, False)
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "report").glob("*.png")} == before


def changed_figure(root: Path) -> None:
    (root / "report" / "cost_return.png").write_bytes(b"no picture")


def removed_figure(root: Path) -> None:
    (root / "report" / "cost_return.svg").unlink()


def other_numbers(root: Path) -> None:
    shutil.rmtree(sorted((root / "results" / "store" / "evaluate").iterdir())[0])


def other_part(root: Path) -> None:
    path = next((root / "results" / "store" / "world_model").glob("*/curves.json"))
    path.write_text(path.read_text() + " ")


def damaged_record(root: Path) -> None:
    (root / "report" / ".figures.json").write_text("{")


@pytest.mark.parametrize("change", [changed_figure, removed_figure, other_numbers, other_part, damaged_record])
def test_what_has_changed_is_drawn_again(
    change: Callable[[Path], None], drawn: Callable[[], tuple[list[str], bool]], tmp_path: Path
) -> None:
    drawn()
    change(tmp_path)
    assert drawn()[1]
    assert not drawn()[1]
