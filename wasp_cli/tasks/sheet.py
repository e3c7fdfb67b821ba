"""A picture of one episode for people: the map, what both cameras see, and what the task is, as a PNG."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import HasScene, Pixels, VectorTask
from wasp_cli.tasks.driver import drive
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.navigation import Navigation
from wasp_cli.tasks.registry import TASKS, task_named
from wasp_cli.tasks.views import from_above

CAMERA, GAP, TITLE, CAPTION = 256, 12, 56, 22
"""Sides and heights in px; a camera image is shown at four times its size."""
MAP = 2 * CAMERA + GAP + CAPTION
MOMENTS, MOMENT = 8, 128
"""Moments of an episode in its strip, and the side of their images in px."""
HELD = 10
"""Decision steps for which a random command is held."""
_INK, _PAPER = (20, 20, 20), (255, 255, 255)


class _Moment(NamedTuple):
    """What is seen after some decision steps."""

    decision: int
    pixels: Pixels
    """[6, 64, 64]"""
    cost: int
    """Costly env steps so far."""
    goals: int


def draw_sheet(task: str, seed: int, steps: int, path: Path | None) -> Path:
    """Draw an episode's first moment, and under it how it goes on.

    Args:
        task: a registered name, one of our gymnasium ids, or the gymnasium id of another environment (which has no map).
        seed: of the episode, and of random commands.
        steps: decision steps to drive and to show in a strip: by the script of `driver`, or at random in environments of others.
        path: the PNG to write; None: `<task>_seed<seed>.png` in the current folder.

    Returns:
        The written file.

    Raises:
        UnknownName: no such task.
        UsageError: the file is no PNG.
    """
    name = task_named(task)
    info = TASKS[name]
    if path is not None and path.suffix.lower() != ".png":
        raise UsageError(f"'{path}' is no name of a picture", "the sheet is a PNG: --out map.png")
    made = make_task(name, 1, observe=("pixels",))
    moments = _driven(made, seed, 0)
    overview = from_above(made, 0, MAP) if isinstance(made, HasScene) else None
    if steps:
        moments = _driven(made, seed, steps)
    goals = f"{info.success_goals} goal{'s' if info.success_goals > 1 else ''}"
    limit = f"{info.env_steps} env steps, {info.env_steps * info.env_seconds:g} s"
    lines = (
        f"{name}   {info.gym_id}   seed {seed}" if not name.endswith(info.gym_id) else f"{name}   seed {seed}",
        f"limit {limit}   ·   success: {goals}   ·   costs: {', '.join(made.cost_sources) or 'none'}",
    )
    sheet = _composed(lines, moments[0].pixels, overview)
    path = path or Path(f"{_file_name(name)}_seed{seed}.png")
    (_with_strip(sheet, moments, made.decision_seconds) if steps else sheet).save(path, format="PNG")
    return path


def _driven(task: VectorTask, seed: int, steps: int) -> list[_Moment]:
    """Evenly spread moments of the first `steps` decision steps, the start first."""
    seen = task.reset([seed])
    random = np.random.default_rng(seed)
    wanted = set(np.linspace(0, steps, MOMENTS).round().astype(int).tolist()) if steps else {0}
    action, cost, goals, moments = np.zeros((1, task.action_size)), 0, 0, []
    for done in range(steps + 1):
        if done:
            if isinstance(task, Navigation):
                action = drive(task)
            elif done % HELD == 1:
                action = random.uniform(task.action_low, task.action_high, (1, task.action_size))
            step = task.step(action)
            seen, cost, goals = step.observation, cost + int(step.cost_env[0]), goals + int(step.goals[0])
        ended = done > 0 and bool(step.ended[0])
        assert seen.pixels is not None
        if done in wanted or ended:
            moments.append(_Moment(done, seen.pixels[0], cost, goals))
        if ended:
            break
    return moments


def _with_strip(sheet: Image.Image, moments: list[_Moment], seconds: float) -> Image.Image:
    """The sheet with front over rear images of the moments below it; a decision step takes `seconds`."""
    small = ImageFont.load_default(11)
    width = max(sheet.width, GAP + len(moments) * (MOMENT + GAP // 2) + GAP // 2)
    longer = Image.new("RGB", (width, sheet.height + 2 * MOMENT + 2 + 2 * CAPTION), _PAPER)
    longer.paste(sheet, (0, 0))
    draw = ImageDraw.Draw(longer)
    for column, moment in enumerate(moments):
        x, y = GAP + column * (MOMENT + GAP // 2), sheet.height
        for row in range(2):
            image = np.ascontiguousarray(np.moveaxis(moment.pixels[3 * row : 3 * row + 3], 0, -1))
            longer.paste(Image.fromarray(image).resize((MOMENT, MOMENT), Image.Resampling.NEAREST), (x, y + row * (MOMENT + 2)))
        text = f"{moment.decision * seconds:.1f} s: cost {moment.cost}, {moment.goals} goal{'s' * (moment.goals != 1)}"
        draw.text((x, y + 2 * MOMENT + 5), text, _INK, small)
    return longer


def _composed(lines: tuple[str, ...], pixels: Pixels, overview: Pixels | None) -> Image.Image:
    left = MAP + GAP if overview is not None else 0
    font, small = ImageFont.load_default(16), ImageFont.load_default(13)
    width = max(GAP + left + CAMERA + GAP, *(int(font.getlength(line)) + 2 * GAP for line in lines))
    sheet = Image.new("RGB", (width, TITLE + MAP + GAP + CAPTION), _PAPER)
    draw = ImageDraw.Draw(sheet)
    for row, line in enumerate(lines):
        draw.text((GAP, 8 + 22 * row), line, _INK, font if row == 0 else small)
    views = [] if overview is None else [("map: +x to the right, +y up", overview, MAP, (GAP, TITLE))]
    for row, name in enumerate(("front camera", "rear camera")):
        image = np.moveaxis(pixels[3 * row : 3 * row + 3], 0, -1)
        if overview is None and not image.any():
            continue  # another's environment with one camera
        views.append((name, image, CAMERA, (GAP + left, TITLE + row * (CAMERA + GAP + CAPTION))))
    for name, image, side, (x, y) in views:
        shown = Image.fromarray(np.ascontiguousarray(image)).resize((side, side), Image.Resampling.NEAREST)
        sheet.paste(shown, (x, y))
        draw.text((x, y + side + 3), name, _INK, small)
    return sheet


def _file_name(task: str) -> str:
    """A task's name without what a file name cannot hold."""
    return "".join(character if character.isalnum() or character in "._-" else "-" for character in task).lstrip(".-")
