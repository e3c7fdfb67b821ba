"""Camera images of episodes that the script drives, of any checkout of this project.

`python images.py CHECKOUT TASK BATCH`: for every line that it reads it writes a line of JSON: the CPU time of a pair of images in `ms`,
and a hash of all of them (`images`).
"""

import hashlib
import json
import sys
import time
from collections.abc import Iterator
from typing import Any

SCENES, APART = 8, 5  # scenes; decisions from one to the next, so that they show different places


def camera(name: str, batch: int) -> Iterator[dict[str, Any]]:
    """Draw the same scenes again and again: those of `batch` episodes, every few decisions."""
    import numpy as np

    from tests.benchmarks.task_speed import made
    from tests.driver import drive
    from wasp_cli.tasks.camera.camera import Camera

    task = made(name, batch, (), 4)
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


if __name__ == "__main__":
    checkout, name, batch = sys.argv[1:]
    sys.path.insert(0, checkout)
    import torch

    from wasp_cli.run.worker import keep_memory

    keep_memory()  # as every worker does
    torch.set_num_threads(1)
    for found in camera(name, int(batch)):
        print(json.dumps(found), flush=True)
        if not sys.stdin.readline():
            break
