"""Tiny untrained models, and a cell that an assistant was evaluated in with them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.artifacts import tiny_artifacts
from tests.cells import Evaluated, evaluated


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return tiny_artifacts(tmp_path_factory.mktemp("artifacts"))


@pytest.fixture(scope="module")
def cell(inputs: Mapping[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    """IDA takes over wherever more of its ensemble are for it than against it."""
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "ida", {"vote": 0.0})
