"""Grids of invented cells."""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from tests.report.invented import Grid, write_grid
from wasp_cli.report.stats import Frame
from wasp_cli.store.layout import Layout

Written = Callable[..., Grid]


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Writes every grid once."""

    @cache
    def write(**size: object) -> Grid:
        return write_grid(tmp_path_factory.mktemp("grid"), **size)  # type: ignore[arg-type]

    return write


@pytest.fixture
def grid(written: Written, tmp_path: Path) -> Written:
    """Copies a grid of invented cells."""

    def copied(**size: object) -> Grid:
        made = written(**size)
        shutil.copytree(made.layout.root, tmp_path, dirs_exist_ok=True)
        return Grid(Layout(tmp_path), list(made.cells))

    return copied


@pytest.fixture(scope="session")
def frame(written: Written) -> Frame:
    """Three seeds, everything computed, one ablation."""
    return written(ablations=("safety-only",)).read()


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time of a report, and other tests look at them."""
    monkeypatch.setattr("wasp_cli.report.summarize.draw_figures", lambda *_: [])
