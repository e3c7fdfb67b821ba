"""Speed of the hot paths. Each benchmark notes the limit that was measured in the same run, so that shares can be compared."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.artifacts import tiny_artifacts
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.closed_loop import human
from wasp_cli.learning.configs import ReturnsConfig, WorldModelConfig
from wasp_cli.learning.world_model import build
from wasp_cli.models.world_model import Batch
from wasp_cli.operators.build import build_operator
from wasp_cli.operators.noise import EpisodeNoise

torch.set_num_threads(1)


def seconds(action: Callable[[], Any], repeats: int = 5) -> float:
    """The fastest of a few calls."""
    action()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        action()
        times.append(time.perf_counter() - begun)
    return min(times)


def matrix_rate() -> float:
    """Floating-point operations per second of plain matrix products of the planner's shape."""
    a, b = torch.randn(640, 512), torch.randn(512, 512)
    return 2 * 640 * 512 * 512 / seconds(lambda: a @ b, 20)


@pytest.mark.parametrize("preset", ["quick", "cpu"])
def test_world_model_update(benchmark: Any, preset: str) -> None:
    sizes = {"quick": {"deter": 192, "variables": 12, "classes": 12, "depth": 8, "head": 96}, "cpu": {}}[preset]
    config = WorldModelConfig(**sizes)
    model = build(config, 2)
    rows, steps = 16, 32
    flags = torch.zeros(rows, steps)
    pixels = torch.randint(0, 256, (rows, steps, 6, 64, 64), dtype=torch.uint8)
    batch = Batch(pixels, torch.randn(rows, steps, 2), flags, flags, flags, flags)
    noise = torch.randn(rows, steps, config.variables, config.classes)
    decoded = torch.arange(0, steps, 4)

    def update() -> None:
        model.zero_grad()
        torch.stack(list(model.losses(batch, noise, decoded, 1.0)[0].values())).sum().backward()

    benchmark(update)
    benchmark.extra_info["frames_per_s"] = rows * steps / benchmark.stats.stats.min


def test_decision_against_matrix_products(benchmark: Any, tmp_path: Path) -> None:
    parts = load_parts(tiny_artifacts(tmp_path), ReturnsConfig())
    always = {"tau_c": 1e-9, "candidates": 64, "elites": 20, "feasible": 20, "iterations": 3, "probe": 64}
    assistant = build_assistant("wasp", always, parts)
    batch = 10
    operator = build_operator("laggy", 0.7, human(parts.skills, 0.08, 2), EpisodeNoise(list(range(batch))), batch)
    assistant.reset(torch.ones(batch, dtype=torch.bool), list(range(batch)))
    latent = parts.world_model.initial(batch)
    with torch.inference_mode():
        a_h = operator.command(latent.features)
        benchmark(assistant.decide, latent, a_h, operator)
    benchmark.extra_info["ms_per_episode"] = 1000 * benchmark.stats.stats.min / batch
    benchmark.extra_info["matrix_gflop_per_s"] = matrix_rate() / 1e9
