"""Grids of invented cells."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from tests.report.invented import write_grid
from wasp_cli.report.stats import Frame, Wanted, read_frame

Written = Callable[..., tuple[Path, list[Wanted]]]


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Writes every grid once."""

    @cache
    def write(**size: object) -> tuple[Path, list[Wanted]]:
        folder = tmp_path_factory.mktemp("grid")
        return folder, write_grid(folder, **size)  # type: ignore[arg-type]

    return write


@pytest.fixture
def grid(written: Written, tmp_path: Path) -> Callable[..., list[Wanted]]:
    """Copies a grid of invented cells."""

    def copied(**size: object) -> list[Wanted]:
        folder, wanted = written(**size)
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        return [replace(cell, path=tmp_path / cell.path.relative_to(folder)) for cell in wanted]

    return copied


@pytest.fixture(scope="session")
def frame(written: Written) -> Frame:
    """Three seeds, everything computed, one ablation."""
    return read_frame(written(ablations=("safety-only",))[1])


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time of a report, and other tests look at them."""
    monkeypatch.setattr("wasp_cli.report.summarize.draw_figures", lambda *_: [])
