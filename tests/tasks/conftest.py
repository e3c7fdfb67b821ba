from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

DATA = Path(__file__).parent / "data"
"""Recordings of the reference package: numbers only, made with safety-gymnasium 1.2.0 on MuJoCo 2.3.3."""


@pytest.fixture(scope="session")
def recorded_folder() -> Path:
    return DATA


@pytest.fixture(scope="session")
def recording() -> dict[str, NDArray[Any]]:
    with np.load(DATA / "PointGoal1_seed0.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
