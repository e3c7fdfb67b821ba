"""`python -m tests.benchmarks.processes [ENV...]`: env steps per second over the number of
processes in which a batch of others' environments is stepped.

Numbers of processes take turns, a slice of time each, so that what else runs on the machine slows
all of them. Ratios are comparable between machines; steps per second are not.
"""

import os
import sys
import time
from collections.abc import Sequence

import numpy as np

from wasp_cli.run.cores import cores
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.foreign.processes import foreign_task

ENVIRONMENTS = (
    "tests.benchmarks.tracks:CarRacingCosts-v0",
    "tests.benchmarks.tracks:RacetrackCosts-v0",
)
BATCH = 8
ROUNDS = 6
SLICE_SECONDS = 2.0


def steps_per_second(task: VectorTask, draws: np.random.Generator) -> float:
    """Env steps per second in a slice of time; those of episodes that end begin anew."""
    steps, begun = 0, time.perf_counter()
    while (spent := time.perf_counter() - begun) < SLICE_SECONDS:
        step = task.step(draws.uniform(-1.0, 1.0, (task.batch, task.action_size)))
        steps += int(step.env_steps.sum())
        if step.ended.any():
            task.reset(draws.integers(0, 1000, int(step.ended.sum())).tolist(), step.ended)
    return steps / spent


def measure(name: str, counts: Sequence[int]) -> dict[int, list[float]]:
    """Env steps per second of each round, by number of processes."""
    tasks = {count: foreign_task(name, BATCH, threads=count) for count in counts}
    draws = {count: np.random.default_rng(0) for count in counts}
    for task in tasks.values():
        task.reset(range(BATCH))
    found: dict[int, list[float]] = {count: [] for count in counts}
    for _ in range(ROUNDS):
        for count in counts:
            found[count].append(steps_per_second(tasks[count], draws[count]))
    for task in tasks.values():
        task.close()  # type: ignore[attr-defined]
    return found


def main(arguments: Sequence[str]) -> None:
    counts = sorted({1, 2, cores()})
    load = os.getloadavg()[0]
    print(f"{BATCH} side by side, {cores()} cores, load {load:.1f} when it began")
    print("environment | processes | env steps/s | times one process: median, least, most")
    for name in arguments or ENVIRONMENTS:
        found = measure(name, counts)
        for count in counts:
            ratios = np.array(found[count]) / np.array(found[1])
            words = f"{np.median(ratios):.2f}, {ratios.min():.2f}, {ratios.max():.2f}"
            print(f"{name} | {count} | {np.median(found[count]):.0f} | {words}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
