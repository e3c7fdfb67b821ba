"""Small invented recordings and the sizes of a tiny world model."""

import numpy as np

from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.shards import Recording

TINY = WorldModelConfig(
    deter=16,
    hidden=16,
    variables=3,
    classes=4,
    depth=2,
    head=16,
    batch=3,
    length=6,
    updates=8,
    warmup=2,
    refit_updates=3,
    refit_horizon=4,
    checkpoint_every=4,
    ahead_starts=5,
    ahead_images=3,
    ahead_horizon=3,
    taught=0,
    privileged=0,
)
SOURCES = ("hazards", "static geoms, contact")


class Interrupted(Exception):
    """Somebody presses Ctrl-C."""


ROWS = np.arange(36)
MIRROR = np.array([[1, 0], [0, -1]], np.float32)


def recording(lengths: tuple[int, ...] = (12, 9, 15), seed: int = 0) -> Recording:
    random = np.random.default_rng(seed)
    rows = sum(lengths)
    first = np.zeros(rows, np.float32)
    first[np.cumsum([0, *lengths[:-1]])] = 1
    return Recording(
        pixels=random.integers(0, 256, (rows, 6, 64, 64), dtype=np.uint8),
        action=random.uniform(-1, 1, (rows, 2)).astype(np.float32),
        cost_env=np.zeros(rows, np.float32),
        reward=random.normal(size=rows).astype(np.float32),
        cost=(random.random(rows) < 0.2).astype(np.float32),
        sources=random.integers(0, 5, (rows, 2)).astype(np.int16),
        goals=random.integers(0, 2, rows).astype(np.int16),
        terminal=np.zeros(rows, np.float32),
        first=first,
        privileged=random.normal(size=(rows, 5)).astype(np.float32),
        episode=np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
        behaviour=np.repeat([("expert", "noisy")[i % 2] for i in range(len(lengths))], lengths),
    )
