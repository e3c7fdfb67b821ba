"""The printed WASP against a literal reading of section 4: one decision, call by call and
number by number.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.base import Heldout
from wasp_cli.methods.configs import PrintedConfig
from wasp_cli.methods.noise import DecisionNoise, as_gumbel
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.methods.wasp.printed import PROBE as PROBING
from wasp_cli.methods.wasp.printed import SEARCH, Printed
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator

GAMMA_R, GAMMA_C, LAM, GOES_ON = 0.9, 0.8, 0.7, 0.5
LOW, HIGH, JITTER = 0.3, 0.6, 0.05
H, L, M, N, PROBE, ELITES, N_F, ITERATIONS, ALPHA, STD, FLOOR = (
    6,
    3,
    2,
    24,
    20,
    6,
    5,
    3,
    0.1,
    0.5,
    0.05,
)
SIZES: dict[str, Any] = {
    "horizon": H,
    "residual_steps": L,
    "candidates": N,
    "probe": PROBE,
    "elites": ELITES,
    "feasible": N_F,
    "iterations": ITERATIONS,
    "rollouts": M,
    "alpha": ALPHA,
    "initial_std": STD,
}
SEED = 11


def pi_h(x: float) -> float:
    return min(1.0, max(-1.0, 0.9 - x))


class Found(NamedTuple):
    reward: float
    cost: float
    effort: float


def eq_7_8(signal: list[float], value: list[float], gamma: float) -> float:
    """TD-lambda return at k = 0; `value` at the arrived states."""
    g = value[-1]
    for k in reversed(range(len(signal))):
        g = signal[k] + gamma * GOES_ON * ((1 - LAM) * value[k] + LAM * g)
    return g


def imagined(x: float, a_h: float, residual: list[float] | None, noise: Tensor) -> Found:
    """Mean over the rollouts of `noise` [H, M, Z]; without a residual the operator alone (Eq.
    9-10), else Eq. 13 as printed.
    """
    total = np.zeros(2)
    for m in range(noise.shape[1]):
        place, rewards, costs, places = x, [], [], []
        for k in range(H):
            command = a_h if k == 0 else pi_h(place)
            action = (
                command if residual is None or k >= L else min(1.0, max(-1.0, a_h + residual[k]))
            )
            place = place + 0.1 * action + JITTER * float(noise[k, m, 0])
            rewards.append(0.1 * action)
            costs.append(1.0 if LOW < place < HIGH else 0.0)
            places.append(place)
        total += [
            eq_7_8(rewards, [0.5 * p for p in places], GAMMA_R),
            eq_7_8(costs, [0.25 * abs(p) for p in places], GAMMA_C),
        ]
    reward, cost = total / noise.shape[1]
    return Found(reward, cost, 0.0 if residual is None else sum(r * r for r in residual))


class Outcome(NamedTuple):
    gate: int
    action: float
    g_cost: float
    g_return: float
    delta_g: float | None
    safe: list[int]
    batches: list[int]  # candidates of every call to the world model, in order


def section_4(x: float, a_h: float, tau_c: float, tau_r: float, variant: str = "full") -> Outcome:
    """One decision, from the same draws as the assistant's."""
    source = DecisionNoise()
    source.reset(torch.ones(1, dtype=torch.bool), [SEED])
    own = source.streams()
    noise = as_gumbel(own.uniform((H, M, 2))[0])[0]
    alone = imagined(x, a_h, None, noise)
    batches, delta_g = [1], None
    gate = 1 if alone.cost > tau_c and variant != "task-only" else 0  # Eq. 9
    if gate == 0 and variant != "safety-only":
        batches.append(PROBE)
        samples = (STD * own.normal(PROBE, L, 1, purpose=PROBING)[0, :, :, 0]).clamp(-2, 2).tolist()
        found = [imagined(x, a_h, sample, noise) for sample in samples]
        safe = [i for i in range(PROBE) if found[i].cost <= tau_c]
        if safe:
            best = max(safe, key=lambda i: found[i].reward - ALPHA * found[i].effort)  # Eq. 11
            delta_g = found[best].reward - alone.reward  # Eq. 12
            gate = 2 if delta_g > tau_r else 0
    if gate == 0:
        return Outcome(0, a_h, alone.cost, alone.reward, delta_g, [], batches)
    normals = own.normal(ITERATIONS, N, L, 1, purpose=SEARCH)[0, :, :, :, 0]
    mean, std = [0.0] * L, [STD] * L
    tasks: list[tuple[float, list[float]]] = []
    safes: list[tuple[float, list[float]]] = []
    counts = []
    for batch in normals:
        batches.append(N)
        samples = [
            [min(2.0, max(-2.0, mean[k] + std[k] * float(n[k]))) for k in range(L)] for n in batch
        ]
        found = [imagined(x, a_h, sample, noise) for sample in samples]
        feasible = [i for i in range(N) if found[i].cost <= tau_c]  # Eq. 14
        s_task = [f.reward - ALPHA * f.effort for f in found]  # Eq. 16
        s_safe = [max(0.0, f.cost - tau_c) + ALPHA * f.effort for f in found]  # Eq. 17
        counts.append(len(feasible))
        tasks += [(s_task[i], samples[i]) for i in feasible]
        safes += list(zip(s_safe, samples, strict=True))
        if len(feasible) >= N_F or variant == "no-case2":
            elites = sorted(feasible, key=lambda i: -s_task[i])[:ELITES]
        else:
            elites = sorted(range(N), key=lambda i: s_safe[i])[:N_F]
        for k in range(L if elites else 0):
            values = [samples[i][k] for i in elites]
            mean[k] = sum(values) / len(values)
            std[k] = max(FLOOR, (sum((v - mean[k]) ** 2 for v in values) / len(values)) ** 0.5)
    chosen = (
        max(tasks, key=lambda pair: pair[0])[1]
        if tasks
        else min(safes, key=lambda pair: pair[0])[1]
    )
    if not tasks and variant == "no-case2":
        chosen = [0.0] * L
    # Eq. 18
    return Outcome(
        gate,
        min(1.0, max(-1.0, a_h + chosen[0])),
        alone.cost,
        alone.reward,
        delta_g,
        counts,
        batches,
    )


class Counted(Corridor):
    """Counts the candidates of every rollout. Any step may end the episode."""

    def __init__(self) -> None:
        super().__init__(LOW, HIGH, JITTER)
        self.calls: list[int] = []
        self.steps = 0

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        if self.steps % H == 0:
            self.calls.append(len(action) // M)
        self.steps += 1
        return super().imagine(latent, action, noise)

    def continues(self, latent: Latent) -> Tensor:
        return torch.full_like(latent.h[..., 0], GOES_ON)


def operator() -> Operator:
    return Operator(lambda features: (0.9 - features[:, :1]).clamp(-1, 1), 1, EpisodeNoise([0]), 1)


def ready(
    world: Corridor, tau_c: float, time_is_up: Callable[[], bool] = lambda: False, **changes: Any
) -> Printed:
    imagination = Imagination(world, LinearCritics(), operator().policy, GAMMA_R, GAMMA_C, LAM)
    assistant = Printed(
        PrintedConfig.model_validate(SIZES | changes), imagination, {"tau_c": tau_c}
    )
    assistant.time_is_up = time_is_up
    assistant.reset(torch.ones(1, dtype=torch.bool), [SEED])
    return assistant


CASES = [
    (0.28, 1.0, 0.4, 0.0, "full", 1),  # the hazard is ahead
    (0.45, 0.1, 1e-6, 0.0, "full", 1),  # nothing is safe: Case II throughout
    (0.45, 0.1, 1e-6, 0.0, "no-case2", 1),
    (-2.0, 0.3, 9.0, -1.0, "full", 2),  # far away: the probe decides
    (-2.0, 0.3, 9.0, 50.0, "full", 0),
    (-2.0, 0.3, 9.0, -1.0, "safety-only", 0),
    (0.28, 1.0, 0.4, -1.0, "task-only", 2),
    (-0.4, 0.9, 0.7, 0.2, "full", 0),
]


@pytest.mark.parametrize(("x", "a_h", "tau_c", "tau_r", "variant", "gate"), CASES)
def test_a_decision_is_section_4(x, a_h, tau_c, tau_r, variant, gate):
    world = Counted()
    assistant = ready(world, tau_c, tau_r=tau_r, variant=variant)
    wanted = section_4(x, a_h, tau_c, tau_r, variant)
    assert wanted.gate == gate
    decision = assistant.decide(world.at(x), torch.tensor([[a_h]]), operator())
    record, planned = decision.record, decision.planned
    assert int(record.gate) == gate
    assert float(record.g_cost) == pytest.approx(wanted.g_cost, abs=1e-5)
    assert float(record.g_return) == pytest.approx(wanted.g_return, abs=1e-5)
    assert wanted.delta_g is None or float(record.delta_g) == pytest.approx(
        wanted.delta_g, abs=1e-5
    )
    assert world.calls == wanted.batches
    assert float(decision.action) == pytest.approx(wanted.action, abs=1e-4)
    if gate:
        assert planned.safe[0].tolist() == wanted.safe
        assert planned.case2[0].tolist() == [count < N_F for count in wanted.safe]


def test_thresholds_are_quantiles_of_the_gates_signals_under_the_unimpaired_expert():
    world, count = Counted(), 30
    assistant = ready(world, 9.0)
    zeros, places = torch.zeros(count), torch.linspace(-2, 0.2, count).tolist()
    a_h = torch.tensor([[pi_h(x)] for x in places])
    cost_ahead = (torch.arange(count) > 24).float()
    found = assistant.calibrate(
        Heldout(world.at(*places), a_h, zeros, zeros, zeros.long(), zeros),
        cost_ahead,
        Operator(operator().policy, 1, EpisodeNoise([0] * count), count),
        5,
    )
    costs, gains = [], []
    for i, x in enumerate(places):
        source = DecisionNoise()
        source.reset(torch.ones(1, dtype=torch.bool), [5 + i])
        own = source.streams()
        noise = as_gumbel(own.uniform((H, M, 2))[0])[0]
        alone = imagined(x, pi_h(x), None, noise)
        samples = (STD * own.normal(PROBE, L, 1, purpose=PROBING)[0, :, :, 0]).clamp(-2, 2).tolist()
        every = [imagined(x, pi_h(x), sample, noise) for sample in samples]
        costs.append(alone.cost)
        gains.append((alone, every))
    tau_c = float(
        np.quantile(
            [cost for cost, ahead in zip(costs, cost_ahead, strict=True) if ahead == 0], 0.95
        )
    )
    quiet = []
    for alone, every in gains:
        safe = [each for each in every if each.cost <= tau_c]
        if alone.cost <= tau_c and safe:
            quiet.append(
                max(safe, key=lambda each: each.reward - ALPHA * each.effort).reward - alone.reward
            )
    assert found["tau_c"] == pytest.approx(tau_c, abs=1e-5)
    assert found["tau_r"] == pytest.approx(float(np.quantile(quiet, 0.95)), abs=1e-4)
    assert (assistant.tau_c, assistant.tau_r) == (found["tau_c"], found["tau_r"])
