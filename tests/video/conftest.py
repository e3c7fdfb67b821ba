"""Tiny untrained models, and a cell that an assistant was evaluated in with them."""

import pytest

from tests.cells import Evaluated, evaluated
from tests.learning.conftest import inputs

__all__ = ["inputs"]


@pytest.fixture(scope="session")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "ida", {"vote": 0.0})
