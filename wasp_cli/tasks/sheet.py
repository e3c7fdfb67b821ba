"""A picture of one episode for people: the map, what both cameras see, and what the task is, as a PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.errors import UsageError
from wasp_cli.tasks.base import HasMap, Pixels, VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS, task_named

CAMERA, GAP, TITLE, CAPTION = 256, 12, 56, 22
"""Sides and heights in px; a camera image is shown at four times its size."""
MAP = 2 * CAMERA + GAP + CAPTION
HELD = 10
"""Decision steps for which a random command is held."""
_INK, _PAPER = (20, 20, 20), (255, 255, 255)


def draw_sheet(task: str, seed: int, steps: int, path: Path | None) -> Path:
    """Draw an episode's first moment, or where it is after some random driving.

    Args:
        task: a registered name, one of our gymnasium ids, or the gymnasium id of another environment (which has no map).
        seed: of the episode, and of the random commands.
        steps: decision steps to drive with random commands.
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
    pixels, driven = _driven(made, seed, steps)
    goals = f"{info.success_goals} goal{'s' if info.success_goals > 1 else ''}"
    limit = f"{info.env_steps} env steps, {info.env_steps * info.env_seconds:g} s"
    lines = (
        f"{name}   {info.gym_id}   seed {seed}{driven}" if not name.endswith(info.gym_id) else f"{name}   seed {seed}{driven}",
        f"limit {limit}   ·   success: {goals}   ·   costs: {', '.join(made.cost_sources)}",
    )
    sheet = _composed(lines, pixels, made.topdown(0, MAP) if isinstance(made, HasMap) else None)
    path = path or Path(f"{_file_name(name)}_seed{seed}.png")
    sheet.save(path, format="PNG")
    return path


def _driven(task: VectorTask, seed: int, steps: int) -> tuple[Pixels, str]:
    """The pixels [6, 64, 64] after `steps`, and what was driven."""
    seen = task.reset([seed])
    random = np.random.default_rng(seed)
    action = np.zeros((1, task.action_size))
    reward, cost, done = 0.0, 0, 0
    for done in range(1, steps + 1):
        if done % HELD == 1:
            action = random.uniform(task.action_low, task.action_high, (1, task.action_size))
        step = task.step(action)
        seen, reward, cost = step.observation, reward + float(step.reward[0]), cost + int(step.cost_env[0])
        if step.ended[0]:
            break
    assert seen.pixels is not None
    return seen.pixels[0], f"   after {done} random decisions: return {reward:.2f}, cost {cost}" if done else ""


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
