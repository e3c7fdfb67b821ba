"""What environments of others draw of themselves, for people: assistants never see it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from wasp_cli.tasks.base import Pixels, VectorTask

PICTURE = "picture"
"""A further name in `observe` of others' environments: they are then made so that they can draw
themselves. Ask for it only to show something to people: it may take time and memory."""


@runtime_checkable
class HasPicture(Protocol):
    """A task that may draw itself."""

    def picture(self, row: int) -> Pixels | None:
        """Return a picture of a row as it is now, uint8 [H, W, 3]; None where it draws none."""
        ...


def picture_of(task: VectorTask, row: int = 0) -> Pixels | None:
    """Return what a task draws of a row, uint8 [H, W, 3]; None where it draws nothing."""
    return task.picture(row) if isinstance(task, HasPicture) else None
