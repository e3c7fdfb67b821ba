from pathlib import Path

import pytest

from tests.report.conftest import without_figures
from tests.run.harness import SMALL, fakes

__all__ = ["fakes", "without_figures"]


@pytest.fixture
def small_spec(tmp_path) -> Path:
    """One seed is enough where processes die."""
    path = tmp_path / "small.yaml"
    path.write_text(SMALL.replace("[0, 1]", "[0]"), encoding="utf-8")
    return path
