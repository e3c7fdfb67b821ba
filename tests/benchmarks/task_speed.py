"""`python -m tests.benchmarks.task_speed [TASK...]`: how fast the tasks run here, on one thread.

A robot is driven by the script of `driver`; time outside of the task is not counted.
"""

import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from tests.driver import drive
from wasp_cli.errors import WaspError
from wasp_cli.tasks.camera.camera import Camera
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.navigation import Navigation
from wasp_cli.tasks.registry import task_named

SECONDS = 1.0  # spent on each figure
COLUMNS = ("task", "env steps/s, batch 32", "env steps/s, single", "image pairs/s", "reset, ms")


def measure(name: str) -> tuple[float, float, float, float]:
    """Measure one task: env steps per second in a batch and of one episode, pairs of images per
    second, and a reset in ms.
    """
    seen, one = made(name, 16, ("pixels",), 4), made(name, 1, (), 1)
    camera, scene, seeds = Camera(seen.appearance()), seen.scene(np.arange(16)), iter(range(10**9))
    return (
        env_steps(made(name, 32, ("privileged",), 4)),
        env_steps(made(name, 1, ("state",), 1)),
        16.0 / mean(lambda: camera.render(scene)),
        1000.0 * mean(lambda: one.reset([next(seeds)])),
    )


def made(name: str, batch: int, observe: Sequence[str], repeat: int) -> Navigation:
    task = make_task(name, batch, action_repeat=repeat, observe=observe)
    if not isinstance(task, Navigation):
        raise WaspError(
            f"task '{name}' cannot be driven by the script", "measure one of the built-in tasks"
        )
    task.reset(range(batch))
    return task


def env_steps(task: Navigation) -> float:
    """Env steps per second under the scripted driver; models are built before the clock runs."""
    spent, steps = 0.0, 0
    warm = time.perf_counter() + SECONDS
    seed = task.batch
    while spent < SECONDS:
        action = drive(task)
        begun = time.perf_counter()
        step = task.step(action)
        now = time.perf_counter()
        if now > warm:
            spent += now - begun
            steps += int(step.env_steps.sum())
        if step.ended.any():
            count = int(step.ended.sum())
            task.reset(range(seed, seed + count), step.ended)
            seed += count
    return steps / spent


def mean(action: Callable[[], object]) -> float:
    """Seconds of a call."""
    action()
    count, begun = 0, time.perf_counter()
    while time.perf_counter() - begun < SECONDS:
        action()
        count += 1
    return (time.perf_counter() - begun) / count


def main(arguments: Sequence[str]) -> None:
    names = [task_named(argument) for argument in arguments] or ["goal1", "race1", "formula1"]
    print(" | ".join(COLUMNS))
    for name in names:
        print(" | ".join([name, *(f"{figure:,.2f}" for figure in measure(name))]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
