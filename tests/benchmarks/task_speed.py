"""`python -m tests.benchmarks.task_speed [TASK...]`: how fast the tasks run here, beside what this machine can do at all.

Every figure is measured on one thread, in this run. A robot is driven by the script of `driver`; time outside of the task is not counted.
"""

import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from wasp_cli.errors import WaspError
from wasp_cli.tasks.camera.camera import Camera
from wasp_cli.tasks.car import NQ
from wasp_cli.tasks.driver import drive
from wasp_cli.tasks.formula.model import build_model as build_formula
from wasp_cli.tasks.goal.model import build_model as build_goal
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.navigation import PHYSICS_STEPS, Navigation
from wasp_cli.tasks.race.model import build_model as build_race
from wasp_cli.tasks.registry import task_named

_RAW: dict[str, Callable[[], mujoco.MjModel]] = {
    "goal": lambda: build_goal(1, 0, True),
    "race": lambda: build_race(0, 1, True),
    "formula": lambda: build_formula(0, 0, True),
}
"""A model of each kind of task as plain MuJoCo would step it: robot, floor, and a vase or the scenery."""


class Speed(NamedTuple):
    """Rates of one task per second, and times in ms."""

    task: str
    raw_steps: float
    """mj_step of the task's model in a plain loop; an env step has ten."""
    batch: float
    """Env steps, 32 episodes side by side, decision steps of four, `privileged` observed."""
    single: float
    """Env steps of one episode, one at a time, `state` observed: as the reference package steps."""
    images: float
    """Pairs of camera images, without physics."""
    seen: float
    """Decision steps of four with a pair of images each, 16 episodes side by side."""
    raw_rays: float
    """Rays of mj_multiRay against one box, through the pixels of an image."""
    reset_ms: float
    snapshot_ms: float
    restore_ms: float


def measure(name: str, seconds: float = 1.0) -> Speed:
    """Measure one task, spending about `seconds` on each figure."""
    seen = _task(name, 16, ("pixels",), 4)
    camera, scene = Camera(seen.appearance()), seen.scene(np.arange(16))
    one = _task(name, 1, (), 1)
    kept = one.snapshot()
    seeds = iter(range(10**9))
    return Speed(
        name,
        _raw_steps(_RAW[seen.name](), seconds),
        _env_steps(_task(name, 32, ("privileged",), 4), seconds),
        _env_steps(_task(name, 1, ("state",), 1), seconds),
        16.0 / _fastest(lambda: camera.render(scene), seconds),
        _env_steps(seen, seconds) / 4.0,
        _raw_rays(seconds),
        1000.0 * _mean(lambda: one.reset([next(seeds)]), seconds / 2.0),
        1000.0 * _mean(one.snapshot, seconds / 4.0),
        1000.0 * _mean(lambda: one.restore(kept), seconds / 4.0),
    )


def _task(name: str, batch: int, observe: Sequence[str], repeat: int) -> Navigation:
    task = make_task(name, batch, action_repeat=repeat, observe=observe)
    if not isinstance(task, Navigation):
        raise WaspError(f"task '{name}' cannot be driven by the script", "measure one of the built-in tasks")
    task.reset(range(batch))
    return task


def _env_steps(task: Navigation, seconds: float) -> float:
    """Env steps per second under the scripted driver; models are built before the clock runs."""
    spent, steps = 0.0, 0
    warm = time.perf_counter() + min(seconds, 1.0)
    seed = task.batch
    while spent < seconds:
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


def _raw_steps(model: mujoco.MjModel, seconds: float) -> float:
    data = mujoco.MjData(model)
    if model.nq == NQ:
        data.qpos[:2] = 6.0, 1.0  # beyond the goal of Race, where a car drives freely
    data.ctrl[:] = 0.02
    return PHYSICS_STEPS / _mean(lambda: mujoco.mj_step(model, data, nstep=PHYSICS_STEPS), seconds / 2.0)


def _raw_rays(seconds: float) -> float:
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom type="box" size="1 1 1" pos="3 0 0"/></worldbody></mujoco>')
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    at = np.linspace(-1.0, 1.0, 64)
    across, up = np.meshgrid(at, at)
    rays = np.stack([np.ones_like(across), across, up], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    count, flat = len(rays), rays.reshape(-1)
    geoms, distance = np.zeros(count, np.int32), np.zeros(count)

    def cast() -> None:
        mujoco.mj_multiRay(model, data, np.zeros(3), flat, None, True, -1, geoms, distance, None, count, 1e3)

    return count / _mean(cast, seconds / 4.0)


def _mean(action: Callable[[], object], seconds: float) -> float:
    action()
    count, begun = 0, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        action()
        count += 1
    return (time.perf_counter() - begun) / max(count, 1)


def _fastest(action: Callable[[], object], seconds: float) -> float:
    action()
    best, until = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < until:
        begun = time.perf_counter()
        action()
        best = min(best, time.perf_counter() - begun)
    return float(best)


_WIDTHS = (10, 13, 13, 9, 15, 13, 12, 9, 10, 9)
_HEADER = (
    ("", "raw mj_step", "env steps/s", "", "image pairs/s", "decisions/s", "raw rays", "reset", "snapshot", "restore"),
    ("task", "per s", "batch 32", "single", "no physics", "with images", "per s", "ms", "ms", "ms"),
)


def main(arguments: Sequence[str]) -> int:
    """Print a table; returns the exit code."""
    if any(argument in ("-h", "--help") for argument in arguments):
        print(__doc__)
        return 0
    try:
        names = [task_named(argument) for argument in arguments] or ["goal1", "race1", "formula1"]
        for line in _HEADER:
            print("".join(f"{title:>{width}s}" for title, width in zip(line, _WIDTHS, strict=True)))
        for name in names:
            s = measure(name)
            figures = (*(f"{rate:,.0f}" for rate in s[1:7]), f"{s.reset_ms:.2f}", f"{s.snapshot_ms:.3f}", f"{s.restore_ms:.3f}")
            print("".join(f"{figure:>{width}s}" for figure, width in zip((s.task, *figures), _WIDTHS, strict=True)), flush=True)
    except WaspError as error:
        print(f"error: {error.message}" + (f"\n       {error.hint}" if error.hint else ""), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
