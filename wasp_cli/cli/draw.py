"""`wasp draw`: pictures of a task's layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from wasp_cli.cli.command import command
from wasp_cli.cli.completion import task_names
from wasp_cli.cli.parameters import argument, option
from wasp_cli.console import say
from wasp_cli.errors import UsageError
from wasp_cli.spec.shipped import SUFFIX, spec_path


@command(
    "wasp draw goal1 --seed 3 --out map.png",
    "wasp draw my_pkg:MyEnv-v0",
    "wasp draw my_spec.yaml",
    codes="0 done, 1 the environment fails or the disk refuses, 2 usage, or no such folder",
)
def draw(
    task: Annotated[
        str,
        argument(
            "TASK",
            "A task (goal1), a gymnasium id (my_pkg:MyEnv-v0), or the file of a spec (its tasks).",
            among=task_names,
        ),
    ],
    seed: Annotated[int, option("N", "Seed of the layout.", min=0, max=2**32 - 1)] = 0,
    out: Annotated[
        Path | None,
        option("PNG", "File of the picture. (default: <task>_seed<N>.png)", "--out", "-o"),
    ] = None,
) -> None:
    """Draw a layout of a task: its map and camera images."""
    from wasp_cli.tasks.sheet import draw_sheet

    if Path(task).suffix != SUFFIX:
        say(str(draw_sheet(task, seed, out)))
        return
    from wasp_cli.spec.load import load

    spec = load(spec_path(Path(task))).spec
    if out is not None and len(spec.tasks) > 1:
        raise UsageError(
            f"'{task}' has {len(spec.tasks)} tasks, and --out names one picture", "leave --out away"
        )
    spec.declare_tasks()
    for name in spec.tasks:
        say(str(draw_sheet(name, seed, out)))
