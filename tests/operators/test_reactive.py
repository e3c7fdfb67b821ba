"""The operator who sees what was executed, and the one who is late and noisy at once."""

import numpy as np
import pytest
import torch
from torch import Tensor

from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.operators.delayed_noisy import DELAY
from wasp_cli.operators.reactive import GAIN, LEAK
from wasp_cli.seeds import operator_seed

SEEDS = [11, 12, 13, 14]
ROWS, STEPS = len(SEEDS), 30


def context() -> OperatorContext:
    return OperatorContext(skill=lambda fraction: lambda f: f[:, :2] * fraction, action_size=2, decision_seconds=0.08)


def operator(name: str, value: float, seeds: list[int] = SEEDS) -> Operator:
    return build_operator(name, value, context(), EpisodeNoise(seeds), len(seeds))


def random(seed: int) -> Tensor:
    """[STEPS, ROWS, 2] in [-1, 1]."""
    return 2 * torch.rand(STEPS, ROWS, 2, generator=torch.Generator().manual_seed(seed)) - 1


def held(alpha: float, executed: float, steps: int, lag: float = 0.5) -> Tensor:
    """Commands [steps, 2] of one who intends 0.2 and has this alpha, while an assistant always executes the same."""
    driver = build_operator("reactive", lag, context(), DrawnNoise(torch.full((steps, 1, 1), alpha)), 1)
    issued = []
    for _ in range(steps):
        issued.append(driver.command(torch.full((1, 2), 0.2))[0])
        driver.observe(torch.full((1, 2), executed))
    return torch.stack(issued)


def test_the_equations_against_a_loop_over_single_numbers():
    lag, intended, executed = 0.7, random(1), random(2)
    driver, noise = operator("reactive", lag), EpisodeNoise(SEEDS)
    alpha = noise.next(1)[:, 0].tolist()
    stick, pushed = np.zeros((ROWS, 2)), np.zeros((ROWS, 2))
    for t in range(STEPS):
        issued = driver.command(intended[t]).numpy()
        for row in range(ROWS):
            for i in range(2):
                stick[row, i] += (1 - lag) * (float(intended[t, row, i]) - stick[row, i])
                wanted = min(max(stick[row, i] + GAIN * pushed[row, i], -1.0), 1.0)
                assert issued[row, i] == pytest.approx(wanted, abs=1e-5)
                overridden = wanted - float(executed[t, row, i])
                pushed[row, i] = LEAK * pushed[row, i] + (1 - alpha[row]) * overridden
                stick[row, i] = min(max(stick[row, i] - alpha[row] * overridden, -1.0), 1.0)
        driver.observe(executed[t])


@pytest.mark.parametrize("alpha", [0.0, 0.5, 1.0 - 1e-6])
def test_commands_stay_bounded_and_the_integrator_cannot_wind_up(alpha):
    against = held(alpha, -1.0, 300)
    assert against.abs().max() <= 1
    driver = build_operator("reactive", 0.5, context(), DrawnNoise(torch.full((320, 1, 1), alpha)), 1)
    for _ in range(300):
        driver.command(torch.full((1, 2), 0.2))
        driver.observe(torch.full((1, 2), -1.0))
    assert driver.memory["pushed"].abs().max() <= 2 / (1 - LEAK)
    for _ in range(20):
        issued = driver.command(torch.full((1, 2), 0.2))
        driver.observe(issued)
    assert (issued - 0.2).abs().max() < 0.15  # left alone, the reaction fades


def test_alpha_is_the_same_at_every_severity_and_is_kept_for_the_episode():
    seeds = [operator_seed("goal1", "reactive", 0, e) for e in range(2000)]
    drivers = [operator("reactive", value, seeds) for value in (0.3, 0.9)]
    for driver in drivers:
        driver.command(torch.zeros(2000, 2))
    first = drivers[0].memory["alpha"].clone()
    assert torch.equal(first, drivers[1].memory["alpha"])
    assert first.mean().item() == pytest.approx(0.5, abs=0.03)
    assert first.std().item() == pytest.approx(1 / np.sqrt(12), abs=0.02)  # uniform
    drivers[0].command(torch.zeros(2000, 2))
    assert torch.equal(drivers[0].memory["alpha"], first)
    drivers[0].reset(torch.arange(2000) < 1000)
    drivers[0].command(torch.zeros(2000, 2))
    assert torch.equal(drivers[0].memory["alpha"][1000:], first[1000:])
    assert not (drivers[0].memory["alpha"][:1000] == first[:1000]).any()


def test_late_and_noisy_is_the_noise_of_the_one_on_the_commands_of_the_other():
    both, late, noisy = operator("delayed-noisy", 0.4), operator("reaction-time", DELAY), operator("noisy", 0.4)
    intended = random(4)
    issued = torch.stack([both.command(seen) for seen in intended])
    delayed = torch.stack([late.command(seen) for seen in intended])
    assert torch.equal(issued, torch.stack([noisy.command(seen) for seen in delayed]))
    assert torch.equal(delayed[2:], intended[:-2])  # 0.16 s are two decisions
    assert 0.2 < (issued != delayed).any(-1).float().mean() < 0.6
