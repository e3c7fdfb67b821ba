"""Speed of the tasks on one thread. Each benchmark notes what plain MuJoCo does in the same run, so that shares can be compared."""

from typing import Any

import numpy as np
import pytest

from tests.benchmarks import task_speed as speed
from wasp_cli.tasks.camera.camera import Camera
from wasp_cli.tasks.driver import drive

NAMES = ["goal1", "race1", "formula1"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("batch", "repeat", "observe"), [(32, 4, ("privileged",)), (1, 1, ("state",))], ids=["batch", "single"])
def test_env_steps(benchmark, name, batch, repeat, observe):
    task = speed._task(name, batch, observe, repeat)
    for _ in range(10):  # builds the models that the way needs
        task.step(drive(task))
    task.reset(range(batch))

    def setup() -> tuple[tuple[Any], dict[str, Any]]:
        if task._ended.any():
            task.reset(range(batch))
        return (drive(task),), {}

    last = benchmark.pedantic(task.step, setup=setup, rounds=100)
    assert last.env_steps.max() <= repeat
    assert last.env_steps.sum() > 0, "the last decision moved nothing"
    benchmark.extra_info["env_steps_per_s"] = batch * repeat / benchmark.stats.stats.mean
    benchmark.extra_info["raw_mj_step_per_s"] = speed._raw_steps(speed._RAW[task.name](), 0.5)


@pytest.mark.parametrize("name", NAMES)
def test_images(benchmark, name):
    task = speed._task(name, 16, ("pixels",), 4)
    camera, scene = Camera(task.appearance()), task.scene(np.arange(16))
    benchmark(camera.render, scene)
    benchmark.extra_info["pairs_per_s"] = 16 / benchmark.stats.stats.mean
    benchmark.extra_info["raw_rays_per_s"] = speed._raw_rays(0.5)


@pytest.mark.parametrize("name", NAMES)
def test_reset(benchmark, name):
    task = speed._task(name, 1, (), 1)
    seeds = iter(range(10**9))
    benchmark(lambda: task.reset([next(seeds)]))


@pytest.mark.parametrize("name", NAMES)
def test_snapshot_and_restore(benchmark, name):
    task = speed._task(name, 1, (), 1)
    benchmark(lambda: task.restore(task.snapshot()))
