"""Grids of invented cells."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.report.invented import write_grid
from wasp_cli.report.stats import Frame, Wanted, read_frame


@pytest.fixture
def grid(tmp_path: Path) -> Callable[..., list[Wanted]]:
    """Writes a grid of invented cells."""
    return partial(write_grid, tmp_path)


@pytest.fixture(scope="session")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Frame:
    """Three seeds, everything computed, one ablation."""
    return read_frame(write_grid(tmp_path_factory.mktemp("grid"), ablations=("safety-only",)))
