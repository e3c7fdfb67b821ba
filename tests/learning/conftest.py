"""Tiny untrained models, and a cell that an assistant was evaluated in with them."""

from pathlib import Path

import pytest

from tests.artifacts import tiny_artifacts
from tests.cells import Evaluated, evaluated


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> dict[str, Path]:
    return tiny_artifacts(tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    """IDA takes over wherever more of its ensemble are for it than against it."""
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "ida", {"vote": 0.0})
