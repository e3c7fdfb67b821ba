"""Tasks from their names. This is not part of the registry because it can change results: keys
cover this module, and not the registry.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from wasp_cli.errors import UsageError
from wasp_cli.tasks.registry import TASKS

if TYPE_CHECKING:
    from wasp_cli.tasks.base import VectorTask


def require_mujoco() -> None:
    """Import MuJoCo. Raises UsageError where it fails because of the variable MUJOCO_GL."""
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, RuntimeError) as error:
        chosen = os.environ.get("MUJOCO_GL")
        if chosen is None:
            raise
        raise UsageError(
            f"MuJoCo does not import with MUJOCO_GL={chosen}: {error}",
            "unset MUJOCO_GL, or set it to egl",
        ) from error


def make_task(
    name: str,
    batch: int,
    *,
    action_repeat: int = 4,
    observe: Sequence[str] = ("pixels", "state", "privileged"),
    threads: int = 1,
) -> VectorTask:
    """Build B = `batch` episodes of a task.

    Args:
        name: a name of `TASKS`.
        batch: episodes side by side.
        action_repeat: env steps per decision step.
        observe: which fields of `Observation` to fill; pixels cost a hundred times a state. Of
            environments of others also `picture` (`wasp_cli.tasks.pictures`).
        threads: threads for physics and cameras; results do not depend on it.
    """
    info = TASKS[name]
    options = {
        "action_repeat": action_repeat,
        "observe": tuple(observe),
        "threads": threads,
        **info.options,
    }
    require_mujoco()
    task: VectorTask = TASKS.load(name)(batch, **options)
    return task
