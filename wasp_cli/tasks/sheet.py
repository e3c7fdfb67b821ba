"""A picture of a layout for people: the map, what both cameras see, and what the task is, as a
PNG.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Pixels
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task, require_mujoco
from wasp_cli.tasks.registry import TASKS, task_named

# sides and heights in px; a camera image is shown at four times its size
CAMERA, GAP, TITLE, CAPTION = 256, 12, 56, 22
MAP = 2 * CAMERA + GAP + CAPTION
_INK, _PAPER = (20, 20, 20), (255, 255, 255)


def draw_sheet(task: str, seed: int, path: Path | None) -> Path:
    """Draw an episode's first moment.

    Args:
        task: a registered name, one of our gymnasium ids, or the gymnasium id of another
            environment (which has no map).
        path: the PNG to write; None: `<task>_seed<seed>.png` in the current folder.

    Returns:
        The written file.
    """
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
    made = make_task(name, 1, observe=("pixels",))
    seen = made.reset([seed])
    # Not above: it imports MuJoCo, and whether that imports is asked first.
    from wasp_cli.tasks.camera.topdown import from_above

    overview = from_above(made, 0, MAP) if isinstance(made, HasScene) else None
    # Others' environments may have one camera; then the rear image of their pixels is black.
    cameras: int = getattr(made, "cameras", 2)
    goals = f"{info.success_goals} goal{'s' if info.success_goals > 1 else ''}"
    limit = f"{info.env_steps} env steps, {info.env_steps * info.env_seconds:g} s"
    lines = (
        f"{name}   {info.gym_id}   seed {seed}"
        if not name.endswith(info.gym_id)
        else f"{name}   seed {seed}",
        f"limit {limit}   ·   success: {goals}   ·   costs: "
        f"{', '.join(made.cost_sources) or 'none'}",
    )
    names = ("front camera", "rear camera") if cameras == 2 else ("camera",)
    if seen.pixels is not None:
        pixels: Pixels | None = seen.pixels[0][: 3 * cameras]
    else:
        # Not above: it imports gymnasium, which our own tasks do without.
        from wasp_cli.tasks.foreign.portrait import portrait

        pixels = portrait(name, seed)
        names = (f"assistants see {made.state_size} numbers",)
    if pixels is None:  # the environment cannot draw itself
        pixels = np.full((3, 1, 1), 255, np.uint8)
    sheet = _composed(lines, pixels, names, overview)
    usable = "".join(
        character if character.isalnum() or character in "._-" else "-" for character in name
    ).lstrip(".-")
    path = path or Path(f"{usable}_seed{seed}.png")
    sheet.save(path, format="PNG")
    return path


def _composed(
    lines: tuple[str, ...], pixels: Pixels, names: tuple[str, ...], overview: Pixels | None
) -> Image.Image:
    """The map, and beside it the images of the cameras that are there: `pixels` is [3 or 6, H, W],
    `names` says what each of them is.
    """
    left = MAP + GAP if overview is not None else 0
    cameras = len(pixels) // 3
    rows = cameras if overview is None else 2  # the map is as high as two cameras
    font, small = ImageFont.load_default(16), ImageFont.load_default(13)
    fonts = (font, *[small] * (len(lines) - 1))
    width = max(
        GAP + left + CAMERA + GAP,
        *(int(face.getlength(line)) + 2 * GAP for line, face in zip(lines, fonts, strict=True)),
    )
    sheet = Image.new("RGB", (width, TITLE + rows * (CAMERA + CAPTION + GAP)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (line, face) in enumerate(zip(lines, fonts, strict=True)):
        draw.text((GAP, 8 + 22 * row), line, _INK, face)
    views = (
        [] if overview is None else [("map: +x to the right, +y up", overview, MAP, (GAP, TITLE))]
    )
    for row, name in enumerate(names):
        image = np.moveaxis(pixels[3 * row : 3 * row + 3], 0, -1)
        views.append((name, image, CAMERA, (GAP + left, TITLE + row * (CAMERA + GAP + CAPTION))))
    for name, image, side, (x, y) in views:
        shown = Image.fromarray(np.ascontiguousarray(image)).resize(
            (side, side), Image.Resampling.NEAREST
        )
        sheet.paste(shown, (x, y))
        draw.text((x, y + side + 3), name, _INK, small)
    return sheet
