"""A picture of one episode for people: the map, what both cameras see, and what the task is, as a PNG."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import Observation, Pixels, VectorTask
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task, require_mujoco
from wasp_cli.tasks.registry import TASKS, task_named

CAMERA, GAP, TITLE, CAPTION = 256, 12, 56, 22  # sides and heights in px; a camera image is shown at four times its size
MAP = 2 * CAMERA + GAP + CAPTION
MOMENTS, MOMENT = 8, 128  # moments of an episode in its strip, and the side of their images in px
KEPT = 512  # moments at most that are kept while an episode is driven: where it will end is not known before
HELD = 10  # decision steps for which a random command is held
_INK, _PAPER = (20, 20, 20), (255, 255, 255)


class _Moment(NamedTuple):
    """What is seen after some decision steps."""

    decision: int
    pixels: Pixels  # [6, 64, 64]
    cost: int  # costly env steps so far
    goals: int


def draw_sheet(task: str, seed: int, steps: int, path: Path | None) -> Path:
    """Draw an episode's first moment, and under it how it goes on.

    Args:
        task: a registered name, one of our gymnasium ids, or the gymnasium id of another environment (which has no map).
        steps: decision steps to drive and to show in a strip: by the script of `driver`, or at random in environments of others.
        path: the PNG to write; None: `<task>_seed<seed>.png` in the current folder.

    Returns:
        The written file.
    """
    name = task_named(task)
    info = TASKS[name]
    if path is not None and path.suffix.lower() != ".png":
        raise UsageError(f"'{path}' is no name of a picture", "the sheet is a PNG: --out map.png")
    if path is not None and not path.parent.is_dir():
        raise UsageError(f"cannot write '{path}': its parent folder does not exist", f"create the folder '{path.parent}'")
    require_mujoco()
    made = make_task(name, 1, observe=("pixels",))
    first = _seen(made.reset([seed]), 0)
    # Not above: it imports MuJoCo, and whether that imports is asked first.
    from wasp_cli.tasks.camera.topdown import from_above

    overview = from_above(made, 0, MAP) if isinstance(made, HasScene) else None
    moments = _driven(made, first, seed, min(steps, made.max_decisions))
    # Others' environments may have one camera; then the rear image of their pixels is black.
    cameras: int = getattr(made, "cameras", 2)
    goals = f"{info.success_goals} goal{'s' if info.success_goals > 1 else ''}"
    limit = f"{info.env_steps} env steps, {info.env_steps * info.env_seconds:g} s"
    lines = (
        f"{name}   {info.gym_id}   seed {seed}" if not name.endswith(info.gym_id) else f"{name}   seed {seed}",
        f"limit {limit}   ·   success: {goals}   ·   costs: {', '.join(made.cost_sources) or 'none'}",
    )
    sheet = _composed(lines, first.pixels[: 3 * cameras], overview)
    usable = "".join(character if character.isalnum() or character in "._-" else "-" for character in name).lstrip(".-")
    path = path or Path(f"{usable}_seed{seed}.png")
    (_with_strip(sheet, moments, cameras, made.decision_seconds) if steps else sheet).save(path, format="PNG")
    return path


def _seen(observation: Observation, decision: int, cost: int = 0, goals: int = 0) -> _Moment:
    assert observation.pixels is not None
    return _Moment(decision, observation.pixels[0], cost, goals)


def _driven(task: VectorTask, first: _Moment, seed: int, steps: int) -> list[_Moment]:
    """Evenly spread moments of `steps` decision steps after a reset, or of as many as there are; the start first, the end last."""
    # Not above: both import MuJoCo, and whether it imports is asked first.
    from wasp_cli.tasks.driver import drive
    from wasp_cli.tasks.navigation import Navigation

    random = np.random.default_rng(seed)
    action, moment, moments, stride = np.zeros((1, task.action_size)), first, [first], 1
    for done in range(1, steps + 1):
        if isinstance(task, Navigation):
            action = drive(task)
        elif done % HELD == 1:
            action = random.uniform(task.action_low, task.action_high, (1, task.action_size))
        step = task.step(action)
        moment = _seen(step.observation, done, moment.cost + int(step.cost_env[0]), moment.goals + int(step.goals[0]))
        last = done == steps or bool(step.ended[0])
        if last or done % stride == 0:
            moments.append(moment)
        if last:
            break
        if len(moments) > KEPT:
            moments, stride = moments[::2], 2 * stride
    chosen = np.linspace(0, len(moments) - 1, min(MOMENTS, len(moments))).round().astype(int)
    return [moments[index] for index in chosen.tolist()]


def _times(moments: list[_Moment], seconds: float) -> list[str]:
    """When the moments are, with as many digits as tell them apart."""
    times = [moment.decision * seconds for moment in moments]
    least = 1 if times[-1] >= 2.0 else 2
    texts = [[f"{time:.{digits}f}" for time in times] for digits in range(least, 7)]
    return next((row for row in texts if len(set(row)) == len(row)), texts[-1])


def _with_strip(sheet: Image.Image, moments: list[_Moment], cameras: int, seconds: float) -> Image.Image:
    """The sheet with front over rear images of the moments below it; a decision step takes `seconds`."""
    small = ImageFont.load_default(11)
    width = max(sheet.width, GAP + len(moments) * (MOMENT + GAP // 2) + GAP // 2)
    high = cameras * (MOMENT + 2)
    longer = Image.new("RGB", (width, sheet.height + high + 2 * CAPTION), _PAPER)
    longer.paste(sheet, (0, 0))
    draw = ImageDraw.Draw(longer)
    for column, (moment, time) in enumerate(zip(moments, _times(moments, seconds), strict=True)):
        x, y = GAP + column * (MOMENT + GAP // 2), sheet.height
        for row in range(cameras):
            image = np.ascontiguousarray(np.moveaxis(moment.pixels[3 * row : 3 * row + 3], 0, -1))
            longer.paste(Image.fromarray(image).resize((MOMENT, MOMENT), Image.Resampling.NEAREST), (x, y + row * (MOMENT + 2)))
        text = f"{time} s: cost {moment.cost}, {moment.goals} goal{'s' * (moment.goals != 1)}"
        draw.text((x, y + high + 3), text, _INK, small)
    return longer


def _composed(lines: tuple[str, ...], pixels: Pixels, overview: Pixels | None) -> Image.Image:
    """The map, and beside it the images of the cameras that are there: `pixels` is [3 or 6, 64, 64]."""
    left = MAP + GAP if overview is not None else 0
    cameras = len(pixels) // 3
    rows = cameras if overview is None else 2  # the map is as high as two cameras
    font, small = ImageFont.load_default(16), ImageFont.load_default(13)
    fonts = (font, *[small] * (len(lines) - 1))
    width = max(GAP + left + CAMERA + GAP, *(int(face.getlength(line)) + 2 * GAP for line, face in zip(lines, fonts, strict=True)))
    sheet = Image.new("RGB", (width, TITLE + rows * (CAMERA + CAPTION + GAP)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, (line, face) in enumerate(zip(lines, fonts, strict=True)):
        draw.text((GAP, 8 + 22 * row), line, _INK, face)
    views = [] if overview is None else [("map: +x to the right, +y up", overview, MAP, (GAP, TITLE))]
    names = ("front camera", "rear camera") if cameras == 2 else ("camera",)
    for row, name in enumerate(names):
        image = np.moveaxis(pixels[3 * row : 3 * row + 3], 0, -1)
        views.append((name, image, CAMERA, (GAP + left, TITLE + row * (CAMERA + GAP + CAPTION))))
    for name, image, side, (x, y) in views:
        shown = Image.fromarray(np.ascontiguousarray(image)).resize((side, side), Image.Resampling.NEAREST)
        sheet.paste(shown, (x, y))
        draw.text((x, y + side + 3), name, _INK, small)
    return sheet
