from pathlib import Path

import pytest

from tests.report.conftest import without_figures
from tests.run.harness import fakes, written

__all__ = ["fakes", "without_figures"]


@pytest.fixture
def small_spec(tmp_path) -> Path:
    """One seed is enough where processes die."""
    return written(tmp_path / "small.yaml", "[0, 1]", "[0]")
