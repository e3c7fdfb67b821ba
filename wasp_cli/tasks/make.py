"""Tasks from their names. Beside the registry, and not in it, because what is done here moves results: keys cover this module."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from wasp_cli.tasks.mujoco_import import require_mujoco
from wasp_cli.tasks.registry import TASKS

if TYPE_CHECKING:
    from wasp_cli.tasks.base import VectorTask


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
        observe: which fields of `Observation` to fill; pixels cost a hundred times a state.
        threads: threads for physics and cameras; results do not depend on it.

    Raises:
        UnknownName: no such task.
        UsageError: MuJoCo does not import, because MUJOCO_GL names what is not there.
    """
    info = TASKS[name]
    options = {"action_repeat": action_repeat, "observe": tuple(observe), "threads": threads, **info.options}
    require_mujoco()
    task: VectorTask = TASKS.load(name)(batch, **options)
    return task
