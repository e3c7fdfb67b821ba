import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from wasp_cli.operators.base import (
    DrawnNoise,
    EpisodeNoise,
    Operator,
    OperatorContext,
    build_operator,
)
from wasp_cli.operators.burst import MEAN_BURST, burst_rates
from wasp_cli.operators.delayed import delay_steps
from wasp_cli.operators.delayed_noisy import DELAY
from wasp_cli.operators.mixed import MixedOperator
from wasp_cli.operators.reactive import GAIN, LEAK
from wasp_cli.seeds import operator_seed

STEPS = 4000


def context() -> OperatorContext:
    return OperatorContext(
        skill=lambda fraction: lambda f: f[:, :2] * fraction, action_size=2, decision_seconds=0.08
    )


def operator(name: str, value: float, rows: int = 1) -> Operator:
    return build_operator(name, value, context(), EpisodeNoise(list(range(rows))), rows)


def rising(step: int, rows: int = 1) -> Tensor:
    return torch.full((rows, 2), (step + 1) / (2 * STEPS))


def test_noise_replaces_the_stated_share_by_uniform_commands():
    noisy = operator("noisy", 0.4)
    issued = torch.stack([noisy.command(rising(t)) for t in range(STEPS)])[:, 0]
    intended = torch.stack([rising(t) for t in range(STEPS)])[:, 0]
    replaced = (issued != intended).any(-1)
    assert replaced.float().mean().item() == pytest.approx(0.4, abs=0.03)
    random = issued[replaced]
    assert random.mean().abs() < 0.06
    assert random.std().item() == pytest.approx(1 / np.sqrt(3), abs=0.03)


def test_lag_repeats_what_was_issued_and_holds_for_the_expected_time():
    laggy = operator("laggy", 0.7)
    issued = torch.stack([laggy.command(rising(t)) for t in range(STEPS)])[:, 0, 0]
    assert issued[0] == rising(0)[0, 0]  # the first command of an episode is fresh
    repeated = issued[1:] == issued[:-1]
    assert repeated.float().mean().item() == pytest.approx(0.7, abs=0.03)
    fresh = ~repeated
    assert torch.equal(
        issued[1:][fresh], torch.stack([rising(t) for t in range(1, STEPS)])[fresh][:, 0, 0]
    )


def mistakes(name: str, value: float, episodes: int) -> Tensor:
    """Issued commands [T, B, A] of evaluation episodes."""
    noise = EpisodeNoise([operator_seed("goal1", name, 0, e) for e in range(episodes)])
    driver = build_operator(name, value, context(), noise, episodes)
    return torch.stack([driver.command(rising(t, episodes)) for t in range(200)])


def test_a_severer_noise_makes_every_mistake_of_a_milder_one():
    intended = torch.stack([rising(t, 3) for t in range(200)])
    mild, severe = mistakes("noisy", 0.2, 3), mistakes("noisy", 0.6, 3)
    wrong = (mild != intended).any(-1)
    assert 0.1 < wrong.float().mean() < 0.3
    assert torch.equal(mild[wrong], severe[wrong])
    assert (severe != intended).any(-1).float().mean() > 0.5


def test_a_severer_lag_repeats_wherever_a_milder_one_does():
    mild, severe = (
        issued[1:, :, 0] == issued[:-1, :, 0]
        for issued in (mistakes("laggy", 0.5, 3), mistakes("laggy", 0.85, 3))
    )
    assert mild.float().mean() > 0.4
    assert (severe | ~mild).all()
    assert severe.sum() > mild.sum()


@pytest.mark.parametrize(
    ("seconds", "step", "wanted"),
    [(0.16, 0.08, 2), (0.24, 0.08, 3), (0.40, 0.08, 5), (0.24, 0.16, 2), (0.4, 0.16, 3)],
)
def test_delays_are_whole_decision_steps_rounded_up(seconds, step, wanted):
    assert delay_steps(seconds, step) == wanted


def test_a_delayed_operator_answers_what_it_saw_then_and_starts_neutral():
    delayed = operator("reaction-time", 0.24)
    issued = torch.stack([delayed.command(rising(t)) for t in range(20)])[:, 0]
    assert (issued[:3] == 0).all()
    assert torch.equal(issued[3:], torch.stack([rising(t) for t in range(17)])[:, 0])


def test_limited_skill_is_the_earlier_checkpoint():
    assert torch.allclose(
        operator("limited-skill", 0.25).command(torch.ones(1, 2)), torch.full((1, 2), 0.25)
    )


def test_a_mixture_draws_an_operator_for_every_episode():
    rows = 200
    noise = EpisodeNoise(list(range(rows)))
    mixed = MixedOperator(
        [build_operator("limited-skill", value, context(), noise, rows) for value in (0.5, 0.1)],
        noise,
        seed=0,
    )
    mixed.reset(torch.ones(rows, dtype=torch.bool))
    seen = mixed.command(torch.ones(rows, 2))[:, 0]
    assert (seen == 0.5).float().mean().item() == pytest.approx(0.5, abs=0.12)
    before = mixed.choice.clone()
    mixed.reset(torch.arange(rows) < 10)
    assert torch.equal(mixed.choice[10:], before[10:])


ROWS, DECISIONS = 40, 500
INTENDED = torch.full((ROWS, 2), 0.25)


def issued(name: str, value: float) -> Tensor:
    """[DECISIONS, ROWS, 2] of operators that always intend 0.25."""
    operator = build_operator(name, value, context(), EpisodeNoise(list(range(ROWS))), ROWS)
    return torch.stack([operator.command(INTENDED) for _ in range(DECISIONS)])


def test_gaussian_noise_has_the_stated_spread_around_the_intended_command():
    error = issued("noisy-gaussian", 0.2) - INTENDED  # the bounds are 3.75 and 6 deviations away
    assert error.mean().abs() < 0.005
    assert error.std().item() == pytest.approx(0.2, rel=0.02)
    inside = (error.abs() < 0.2).float().mean().item()
    # of a normal distribution; a uniform one has 0.577
    assert inside == pytest.approx(0.683, abs=0.01)


def test_a_draw_of_zero_gives_a_finite_command():
    operator = build_operator("noisy-gaussian", 0.5, context(), DrawnNoise(torch.zeros(1, 1, 2)), 1)
    assert torch.equal(operator.command(torch.zeros(1, 2)), torch.full((1, 2), -1.0))


def in_burst(name: str, value: float) -> Tensor:
    """[DECISIONS, ROWS] whether the command was replaced."""
    return (issued(name, value) != INTENDED).any(-1)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_bursts_have_the_stated_share_and_the_stated_length(share):
    on = in_burst("noisy-burst", share)
    assert on.float().mean().item() == pytest.approx(share, abs=0.03)
    ends = (on[:-1] & ~on[1:]).sum().item()
    assert on[:-1].sum().item() / ends == pytest.approx(MEAN_BURST, rel=0.12)


@given(st.floats(0.0, 1.0))
def test_rates_of_bursts_are_probabilities_with_the_stated_stationary_share(share):
    start, stop = burst_rates(share)
    assert 0.0 <= start <= 1.0 + 1e-12
    assert 0.0 <= stop <= 1.0 / MEAN_BURST
    assert start / (start + stop) == pytest.approx(share, abs=1e-9)


def test_an_operator_without_noise_is_the_expert():
    for name in ("noisy", "noisy-gaussian", "noisy-burst", "laggy", "reaction-time"):
        operator: Operator = build_operator(name, 0.0, context(), EpisodeNoise([1, 2]), 2)
        assert torch.equal(operator.command(INTENDED[:2]), INTENDED[:2]), name


# The reactive who sees what was executed, and the one who is late and noisy at once.


SEEDS = [11, 12, 13, 14]
REACTIVE_ROWS, REACTIVE_STEPS = len(SEEDS), 30


def reactive(name: str, value: float, seeds: list[int] = SEEDS) -> Operator:
    return build_operator(name, value, context(), EpisodeNoise(seeds), len(seeds))


def random(seed: int) -> Tensor:
    """[REACTIVE_STEPS, REACTIVE_ROWS, 2] in [-1, 1]."""
    return (
        2
        * torch.rand(
            REACTIVE_STEPS, REACTIVE_ROWS, 2, generator=torch.Generator().manual_seed(seed)
        )
        - 1
    )


def held(alpha: float, executed: float, steps: int, lag: float = 0.5) -> Tensor:
    """Commands [steps, 2] of one who intends 0.2 and has this alpha, while an assistant always
    executes the same.
    """
    driver = build_operator(
        "reactive", lag, context(), DrawnNoise(torch.full((steps, 1, 1), alpha)), 1
    )
    issued = []
    for _ in range(steps):
        issued.append(driver.command(torch.full((1, 2), 0.2))[0])
        driver.observe(torch.full((1, 2), executed))
    return torch.stack(issued)


def test_the_equations_against_a_loop_over_single_numbers():
    lag, intended, executed = 0.7, random(1), random(2)
    driver, noise = reactive("reactive", lag), EpisodeNoise(SEEDS)
    alpha = noise.next(1)[:, 0].tolist()
    stick, pushed = np.zeros((REACTIVE_ROWS, 2)), np.zeros((REACTIVE_ROWS, 2))
    for t in range(REACTIVE_STEPS):
        issued = driver.command(intended[t]).numpy()
        for row in range(REACTIVE_ROWS):
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
    driver = build_operator(
        "reactive", 0.5, context(), DrawnNoise(torch.full((320, 1, 1), alpha)), 1
    )
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
    drivers = [reactive("reactive", value, seeds) for value in (0.3, 0.9)]
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
    both, late, noisy = (
        reactive("delayed-noisy", 0.4),
        reactive("reaction-time", DELAY),
        reactive("noisy", 0.4),
    )
    intended = random(4)
    issued = torch.stack([both.command(seen) for seen in intended])
    delayed = torch.stack([late.command(seen) for seen in intended])
    assert torch.equal(issued, torch.stack([noisy.command(seen) for seen in delayed]))
    assert torch.equal(delayed[2:], intended[:-2])  # 0.16 s are two decisions
    assert 0.2 < (issued != delayed).any(-1).float().mean() < 0.6
