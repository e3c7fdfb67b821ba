"""A picture of a layout for people: the map, what both cameras see, and what the task is, as a
PNG.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Pixels
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task, require_mujoco
from wasp_cli.tasks.registry import TASKS, task_named

# sides and heights in px; a camera image is shown at four times its size
CAMERA = 256
GAP = 12
TITLE = 56
CAPTION = 22
MAP = 2 * CAMERA + GAP + CAPTION
_INK = (20, 20, 20)
_PAPER = (255, 255, 255)


class _View(NamedTuple):
    """An image on the sheet."""

    caption: str
    image: Pixels  # [H, W, 3]
    side: int  # as it is shown, in px
    x: int  # upper left corner
    y: int


def draw_sheet(task: str, seed: int, path: Path | None) -> Path:
    """Draw the first moment of an episode.

    Args:
        task: a registered name, one of our gymnasium ids, or the gymnasium id of another
            environment (which has no map).
        path: the PNG to write; None: `<task>_seed<seed>.png` in the current folder.

    Returns:
        The written file.

    Raises:
        UsageError: the path does not end with .png, or its folder does not exist.
        UnknownName: there is no such task.
    """
    # Arguments.
    name = task_named(task)
    info = TASKS[name]
    if path is not None and path.suffix.lower() != ".png":
        raise UsageError(f"'{path}' is no name of a picture", "the sheet is a PNG: --out map.png")
    if path is not None and not path.parent.is_dir():
        raise UsageError(
            f"cannot write '{path}': its parent folder does not exist",
            f"create the folder '{path.parent}'",
        )
    require_mujoco()

    # The episode, from above and as assistants see it.
    made = make_task(name, 1, observe=("pixels",))
    observation = made.reset([seed])
    # Not above: it imports MuJoCo, and whether that imports is asked first.
    from wasp_cli.tasks.camera.topdown import from_above

    overview = from_above(made, 0, MAP) if isinstance(made, HasScene) else None
    # Others' environments may have one camera; then the rear image of their pixels is black.
    cameras: int = getattr(made, "cameras", 2)
    names = ("front camera", "rear camera") if cameras == 2 else ("camera",)
    if observation.pixels is not None:
        pixels: Pixels | None = observation.pixels[0][: 3 * cameras]
    else:
        # Not above: it imports gymnasium, which our own tasks do without.
        from wasp_cli.tasks.foreign.portrait import portrait

        pixels = portrait(name, seed)
        names = (f"assistants see {made.state_size} numbers",)
    if pixels is None:  # the environment cannot draw itself
        pixels = np.full((3, 1, 1), 255, np.uint8)

    # What the task is, in words.
    title = f"{name}   seed {seed}"
    if not name.endswith(info.gym_id):
        title = f"{name}   {info.gym_id}   seed {seed}"
    limit = f"{info.env_steps} env steps, {info.env_steps * info.env_seconds:g} s"
    goals = f"{info.success_goals} goal{'s' if info.success_goals > 1 else ''}"
    costs = ", ".join(made.cost_sources) or "none"
    rules = f"limit {limit}   ·   success: {goals}   ·   costs: {costs}"

    sheet = _composed((title, rules), pixels, names, overview)
    if path is None:
        path = Path(f"{_file_name(name)}_seed{seed}.png")
    sheet.save(path, format="PNG")
    return path


def _file_name(task: str) -> str:
    """A task's name without the characters that a file's name may not have everywhere."""
    usable = [character if character.isalnum() or character in "._-" else "-" for character in task]
    return "".join(usable).lstrip(".-")


def _composed(
    lines: tuple[str, ...], pixels: Pixels, names: tuple[str, ...], overview: Pixels | None
) -> Image.Image:
    """The map, and beside it the images of the cameras that are there: `pixels` is [3 or 6, H, W],
    `names` says what each of them is.
    """
    left = MAP + GAP if overview is not None else 0
    cameras = len(pixels) // 3
    rows = cameras if overview is None else 2  # the map is as high as two cameras
    # A sheet that is wide enough for the lines: the first is the title, in a larger font.
    large = ImageFont.load_default(16)
    small = ImageFont.load_default(13)
    fonts = [small for _ in lines]
    fonts[0] = large
    widths = [int(font.getlength(line)) for line, font in zip(lines, fonts, strict=True)]
    width = max(GAP + left + CAMERA + GAP, max(widths) + 2 * GAP)
    sheet = Image.new("RGB", (width, TITLE + rows * (CAMERA + CAPTION + GAP)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (line, font) in enumerate(zip(lines, fonts, strict=True)):
        draw.text((GAP, 8 + 22 * row), line, _INK, font)

    # The map and the images, each with its caption below.
    views: list[_View] = []
    if overview is not None:
        views.append(_View("map: +x to the right, +y up", overview, MAP, GAP, TITLE))
    for row, name in enumerate(names):
        image = np.moveaxis(pixels[3 * row : 3 * row + 3], 0, -1)
        y = TITLE + row * (CAMERA + GAP + CAPTION)
        views.append(_View(name, image, CAMERA, GAP + left, y))
    for view in views:
        shown = Image.fromarray(np.ascontiguousarray(view.image))
        shown = shown.resize((view.side, view.side), Image.Resampling.NEAREST)
        sheet.paste(shown, (view.x, view.y))
        draw.text((view.x, view.y + view.side + 3), view.caption, _INK, small)
    return sheet
