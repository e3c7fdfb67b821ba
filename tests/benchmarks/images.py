"""Camera images of episodes that the script drives, and an update of PPO that looks through them: of any checkout of this project.

`python images.py camera|ppo CHECKOUT TASK BATCH`: for every line that it reads it writes a line of JSON with CPU times in ms.

camera: of a pair of images (`ms`), and a hash of all of them (`images`).
ppo: of a rollout and its update (`ms`), and the shares of the camera and of the whole task in it (`camera`, `task`); BATCH environments.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

SCENES, APART, ROLLOUT = 8, 5, 16
"""Scenes; decisions from one to the next, so that they show different places; decisions of an environment in a rollout."""


def camera(name: str, batch: int) -> Iterator[dict[str, Any]]:
    """Draw the same scenes again and again: those of `batch` episodes, every few decisions."""
    import numpy as np

    from tests.benchmarks.task_speed import _task
    from wasp_cli.tasks.camera.camera import Camera
    from wasp_cli.tasks.driver import drive

    task = _task(name, batch, (), 4)
    scenes = []
    for decision in range(SCENES * APART):
        if decision % APART == 0:
            scenes.append(task.scene(np.arange(batch)))
        step = task.step(drive(task))
        if step.ended.any():
            task.reset(range(int(step.ended.sum())), step.ended)
    draw = Camera(task.appearance()).render
    digest = hashlib.sha256(b"".join(draw(scene).tobytes() for scene in scenes)).hexdigest()
    while True:
        begun = time.process_time()
        for scene in scenes:
            draw(scene)
        yield {"ms": 1000 * (time.process_time() - begun) / (SCENES * batch), "images": digest}


def ppo(name: str, batch: int) -> Iterator[dict[str, Any]]:
    """Train as a latent expert is reinforced at `cpu`, with the filter of an untrained world model, for one short rollout at a time."""
    import itertools

    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    from wasp_cli.learning.configs import ReinforceConfig, WorldModelConfig
    from wasp_cli.learning.latent_ppo import FilteredTask
    from wasp_cli.learning.world_model import build
    from wasp_cli.tasks.camera.camera import Camera
    from wasp_cli.tasks.make import make_task

    torch.manual_seed(0)
    spent: dict[str, float] = {}
    task = make_task(name, batch, action_repeat=4, observe=("pixels",))
    config = ReinforceConfig()
    Camera.render = timed(Camera.render, spent, "camera")
    task.step = timed(task.step, spent, "task")
    seeds = itertools.count()
    env = FilteredTask(task, build(WorldModelConfig(), task.action_size).eval(), lambda: next(seeds))
    learner = PPO("MlpPolicy", env, device="cpu", seed=0, n_steps=ROLLOUT, batch_size=config.batch, n_epochs=config.epochs,
                  policy_kwargs={"net_arch": [128, 128]})  # fmt: skip
    learner.set_logger(Logger(folder=None, output_formats=[]))
    while True:
        spent.update(camera=0.0, task=0.0)
        begun = time.process_time()
        learner.learn(ROLLOUT * batch, reset_num_timesteps=False)
        whole = time.process_time() - begun
        yield {"ms": 1000 * whole, "camera": spent["camera"] / whole, "task": spent["task"] / whole}


def timed(call: Callable[..., Any], spent: dict[str, float], name: str) -> Callable[..., Any]:
    """Wrap a call so that its CPU time is added to `spent`."""

    def wrapped(*arguments: Any, **options: Any) -> Any:
        begun = time.process_time()
        try:
            return call(*arguments, **options)
        finally:
            spent[name] = spent.get(name, 0.0) + time.process_time() - begun

    return wrapped


if __name__ == "__main__":
    kind, checkout, name, batch = sys.argv[1:]
    sys.path.insert(0, checkout)
    import torch

    from wasp_cli.memory import keep_memory

    keep_memory()  # as every worker does
    torch.set_num_threads(1)
    for found in {"camera": camera, "ppo": ppo}[kind](name, int(batch)):
        print(json.dumps(found), flush=True)
        if not sys.stdin.readline():
            break
