from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

DATA = Path(__file__).parent / "data"
"""Recordings of the reference package: numbers only, made with safety-gymnasium 1.2.0 on MuJoCo
2.3.3.
"""


def load_recording(name: str) -> dict[str, NDArray[Any]]:
    with np.load(DATA / name, allow_pickle=False) as archive:
        return {field: archive[field] for field in archive.files}
