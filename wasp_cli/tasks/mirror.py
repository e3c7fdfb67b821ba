"""Tasks that look and work the same in a mirror: with left and right exchanged, every recorded episode is another possible one.

A task says so by the class attribute `mirror`: the matrix that turns an action into that of the mirrored episode. A task with a map of its
own has none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wasp_cli.tasks.registry import TASKS


def mirror_of(task: str) -> NDArray[np.float32] | None:
    """[A, A] of a task by its name; None where there is none, or where it is somebody else's environment."""
    matrix: Any = getattr(TASKS.load(task), "mirror", None)
    return None if matrix is None else np.array(matrix, np.float32)
