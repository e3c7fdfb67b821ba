"""Speed of the hot paths. Each benchmark notes the limit that was measured in the same run, so that shares can be compared."""

import time
from collections.abc import Callable
from typing import Any

import pytest
import torch

from wasp_cli.learning.assistants import build_assistant
from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.sampling import generator, roll_prior
from wasp_cli.learning.world_model import build
from wasp_cli.models.world_model import Batch
from wasp_cli.operators.base import EpisodeNoise, OperatorContext, build_operator

torch.set_num_threads(1)


def seconds(action: Callable[[], Any], repeats: int = 5) -> float:
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


SIZES: dict[str, dict[str, int]] = {"quick": {"deter": 192, "variables": 12, "classes": 12, "depth": 8, "head": 96}, "cpu": {}}


@pytest.mark.parametrize("preset", SIZES)
def test_world_model_update(benchmark, preset):
    """A whole training step of 16 sequences of 32 steps, a quarter of them decoded, beside its images alone."""
    config = WorldModelConfig(**SIZES[preset])
    model = build(config, 2)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4, fused=True)
    rows, steps = 16, 32
    flags = torch.zeros(rows, steps)
    pixels = torch.randint(0, 256, (rows, steps, 6, 64, 64), dtype=torch.uint8)
    batch = Batch(pixels, torch.randn(rows, steps, 2), flags, flags, flags, flags)
    noise = torch.randn(rows, steps, config.variables, config.classes)
    decoded = torch.arange(0, steps, 4)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(model.losses(batch, noise, decoded, 1.0)[0].values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
        optimizer.step()

    features = torch.randn(rows * len(decoded), model.feature_size)

    def images() -> None:
        optimizer.zero_grad(set_to_none=True)
        (model.embed(pixels.flatten(0, 1)).sum() + model.decoder(features).square().sum()).backward()

    benchmark.pedantic(update, rounds=5, warmup_rounds=1)
    benchmark.extra_info["frames_per_s"] = rows * steps / benchmark.stats.stats.min
    benchmark.extra_info["share_of_images"] = seconds(images, 3) / benchmark.stats.stats.min
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters()), "the update went wrong"


@pytest.mark.parametrize("batch", [1, 10])
def test_filter_step(benchmark, batch):
    """What a decision waits for before anything is decided, beside its image encoder alone."""
    model = build(WorldModelConfig(), 2)
    pixels = torch.randint(0, 256, (batch, 6, 64, 64), dtype=torch.uint8)
    action, first = torch.zeros(batch, 2), torch.zeros(batch)
    with torch.inference_mode():
        latent = model.initial(batch)
        seen = benchmark.pedantic(model.filter, (latent, action, pixels, first), rounds=30, warmup_rounds=3)
        assert seen.features.shape == (batch, model.feature_size)
        benchmark.extra_info["ms"] = 1000 * benchmark.stats.stats.min
        benchmark.extra_info["share_of_encoder"] = seconds(lambda: model.embed(pixels), 20) / benchmark.stats.stats.min


@pytest.mark.parametrize("batch", [300, 4096])
def test_imagination(benchmark, batch):
    """Fifteen prior steps under given actions, as a share of what plain matrix products reach."""
    config, horizon = WorldModelConfig(), 15
    model = build(config, 2)
    z, hidden, deter = config.variables * config.classes, config.hidden, config.deter
    products = 2 * ((z + 2) * hidden + 3 * deter * (hidden + deter) + deter * hidden + hidden * z)
    actions, source = torch.randn(batch, horizon, 2), generator(0)
    with torch.inference_mode():
        start = model.initial(batch)
        arrived = benchmark.pedantic(roll_prior, (model, start, actions, source), rounds=3, warmup_rounds=1)
        assert arrived.features.shape == (batch, horizon, model.feature_size)
    rate = batch * horizon / benchmark.stats.stats.min
    benchmark.extra_info["steps_per_s"] = rate
    benchmark.extra_info["share_of_matrix_products"] = rate * products / matrix_rate()


def test_decision_against_matrix_products(benchmark, parts):
    always = {"tau_c": 1e-9, "candidates": 64, "elites": 20, "feasible": 20, "iterations": 3, "probe": 64}
    assistant = build_assistant("wasp", always, parts)
    batch = 10
    operator = build_operator("laggy", 0.7, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise(list(range(batch))), batch)
    assistant.reset(torch.ones(batch, dtype=torch.bool), list(range(batch)))
    latent = parts.world_model.initial(batch)
    with torch.inference_mode():
        a_h = operator.command(latent.features)
        benchmark(assistant.decide, latent, a_h, operator)
    benchmark.extra_info["ms_per_episode"] = 1000 * benchmark.stats.stats.min / batch
    benchmark.extra_info["matrix_gflop_per_s"] = matrix_rate() / 1e9
