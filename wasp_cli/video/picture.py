"""Pictures that environments of other packages draw of themselves, fitted into films and pages.

Pictures are uint8 [H, W, 3].
"""

from __future__ import annotations

from PIL import Image, ImageDraw

from wasp_cli.tasks.base import Pixels
from wasp_cli.tasks.pictures import PICTURE
from wasp_cli.tasks.registry import TASKS, ForeignInfo

DRAWN = "drawn by the environment"
"""What stands above such a picture."""
_PAPER = (255, 255, 255)
_EDGE = (205, 205, 205)


def asking_for_pictures(task: str) -> tuple[str, ...]:
    """Return what `observe` of `make_task` has to name so that a task may draw itself; empty for
    our own tasks, which never do.
    """
    return (PICTURE,) if isinstance(TASKS[task], ForeignInfo) else ()


def fitted(picture: Pixels, size: int) -> Image.Image:
    """Return a picture in the middle of a white square of `size` px, as large as it fits."""
    drawn = Image.fromarray(picture)
    scale = size / max(drawn.size)
    shape = (max(1, round(drawn.width * scale)), max(1, round(drawn.height * scale)))
    # The pixels of small pictures stay visible, like those of cameras.
    how = Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST
    square = Image.new("RGB", (size, size), _PAPER)
    left = (size - shape[0]) // 2
    top = (size - shape[1]) // 2
    square.paste(drawn.resize(shape, how), (left, top))
    return square


def outline(image: Image.Image, where: tuple[int, int], size: int) -> None:
    """Draw a thin line around a square of `size` px that was pasted at `where`. A picture on white
    would have no edge on a white page otherwise.
    """
    x, y = where
    ImageDraw.Draw(image).rectangle((x - 1, y - 1, x + size, y + size), outline=_EDGE)
