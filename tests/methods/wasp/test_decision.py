"""WASP's decision against a literal reading: the command, then the expert, beside the expert
now, then the expert.
"""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.base import Decision, Heldout
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.noise import DecisionNoise, as_gumbel
from wasp_cli.methods.wasp.assistant import GATES, MISTAKES, WASP
from wasp_cli.methods.wasp.imagine import Imagination
from wasp_cli.metrics.episode import GATE_NONE, GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.operators.laggy import LaggyOperator
from wasp_cli.tasks.motors import UNKNOWN, Motors

GAMMA_R, GAMMA_C, LAM, GOES_ON = 0.9, 0.8, 0.7, 0.9
LOW, HIGH, JITTER = 0.3, 0.6, 0.05
H, L, M = 6, 3, 4
SEED = 11
SIZES: dict[str, Any] = {
    "horizon": H,
    "residual_steps": L,
    "candidates": 24,
    "elites": 6,
    "feasible": 5,
    "iterations": 3,
    "rollouts": M,
}
COARSE = Motors((0.2,))


class Ending(Corridor):
    """A corridor in which every step may end the episode."""

    def __init__(self) -> None:
        super().__init__(LOW, HIGH, JITTER)

    def continues(self, latent: Latent) -> Tensor:
        return torch.full_like(latent.h[..., 0], GOES_ON)


def expert(x: float) -> float:
    """He stops before the hazard, and once beyond it he drives on."""
    return min(1.0, max(-1.0, 4 * (0.2 - x))) if x < LOW else 1.0


def policy(features: Tensor) -> Tensor:
    x = features[:, :1]
    return torch.where(x < LOW, (4 * (0.2 - x)).clamp(-1, 1), 1.0)


def unimpaired(rows: int = 1) -> Operator:
    return Operator(policy, 1, EpisodeNoise([0] * rows), rows)


def ready(motors: Motors = UNKNOWN, rows: int = 1, **changes: Any) -> WASP:
    imagination = Imagination(Ending(), LinearCritics(), policy, GAMMA_R, GAMMA_C, LAM)
    assistant = WASP(WASPConfig.model_validate(SIZES | changes), imagination, {}, motors)
    assistant.reset(torch.ones(rows, dtype=torch.bool), [SEED + row for row in range(rows)])
    return assistant


def future(
    x: float, first: float, noise: Tensor, error: float = 0.0, rho: float = 0.0
) -> tuple[float, float]:
    """(G^(r), G^(c)) of one action, then the expert with an error of which the share rho lasts:
    means over the rollouts of `noise` [H, M, Z].
    """
    total = np.zeros(2)
    for m in range(noise.shape[1]):
        place, rewards, costs, values = x, [], [], []
        for k in range(H):
            action = first if k == 0 else min(1.0, max(-1.0, expert(place) + rho**k * error))
            place = place + 0.1 * action + JITTER * float(noise[k, m, 0])
            rewards.append(0.1 * action)
            costs.append(1.0 if LOW < place < HIGH else 0.0)
            values.append(0.5 * place)
        g_r, g_c = values[-1], 0.0
        for k in reversed(range(H)):
            g_r = rewards[k] + GAMMA_R * GOES_ON * ((1 - LAM) * values[k] + LAM * g_r)
            g_c = costs[k] + (GAMMA_C * GOES_ON * g_c if k < H - 1 else 0.0)
        total += [g_r, g_c]
    reward, cost = total / noise.shape[1]
    return reward, cost


def drawn(seed: int, steps: int = H) -> Tensor:
    source = DecisionNoise()
    source.reset(torch.ones(1, dtype=torch.bool), [seed])
    return as_gumbel(source.streams().uniform((steps, M, 2), (steps, M, 0), purpose=GATES)[0])[0]


def decided(assistant: WASP, x: float, a_h: float, operator: Operator | None = None) -> Decision:
    model = assistant.imagination.model
    return assistant.decide(model.at(x), torch.tensor([[a_h]]), operator or unimpaired())


CASES = [
    (-2.0, -0.9),
    (-2.0, 0.99),
    (0.1, 1.0),
    (0.1, 0.2),
    (0.25, 0.9),
    (0.45, 0.9),
    (0.45, -0.5),
    (0.22, 0.5),
]


@pytest.mark.parametrize(("tau_c", "tau_r"), [(0.3, 0.05), (0.05, 0.05), (1.0, 0.15), (0.3, 9.0)])
@pytest.mark.parametrize(
    ("variant", "rho"),
    [
        ("full", 0.0),
        ("full", 0.6),
        ("full", 1.0),
        ("safety-only", 0.6),
        ("task-only", 1.0),
    ],
)
@pytest.mark.parametrize(("x", "a_h"), CASES)
def test_the_gates_compare_three_futures(x, a_h, variant, rho, tau_c, tau_r):
    noise = drawn(SEED)
    g_r, once = future(x, a_h, noise)
    better, safer = future(x, expert(x), noise)
    g_c = once
    if variant != "task-only" and rho:
        g_c = max(once, future(x, a_h, noise, a_h - expert(x), rho)[1])
    decision = decided(ready(tau_c=tau_c, tau_r=tau_r, variant=variant, error_lasts=rho), x, a_h)
    record = decision.record
    assert float(record.g_cost) == pytest.approx(g_c, abs=1e-5)
    assert float(record.g_return) == pytest.approx(g_r, abs=1e-5)
    assert float(record.delta_g) == pytest.approx(better - g_r, abs=1e-5)

    gate = GATE_NONE
    harms = g_c > tau_c and (once > tau_c or safer < g_c)
    if harms and variant != "task-only":
        gate = GATE_SAFETY
    elif better - g_r > tau_r and safer <= tau_c and variant != "safety-only":
        gate = GATE_TASK
    assert int(record.gate) == gate
    if gate == GATE_NONE:
        assert float(decision.action) == np.float32(a_h)
    elif safer <= tau_c:
        assert float(decision.action) == pytest.approx(expert(x), abs=1e-6)
    searched = gate == GATE_SAFETY and safer > tau_c
    assert (decision.planned.safe[0] >= 0).all() == searched


def test_an_error_that_lasts_is_seen_before_a_single_command_does_harm():
    """At x = .05 the expert can still stop after one decision of full throttle. With the same
    error at every decision it comes to rest at the edge of the hazard.
    """
    gates = [
        int(decided(ready(tau_c=0.3, tau_r=9.0, error_lasts=rho), 0.05, 1.0).record.gate)
        for rho in (0.0, 1.0)
    ]
    assert gates == [GATE_NONE, GATE_SAFETY]


def test_the_cases_above_hold_every_outcome():
    seen = set()
    for x, a_h in CASES:
        for tau_c, tau_r in [(0.3, 0.05), (0.05, 0.05)]:
            decision = decided(ready(tau_c=tau_c, tau_r=tau_r), x, a_h)
            seen.add((int(decision.record.gate), bool((decision.planned.safe >= 0).any())))
    assert seen == {
        (GATE_NONE, False),
        (GATE_SAFETY, False),
        (GATE_SAFETY, True),
        (GATE_TASK, False),
    }


def test_nothing_of_the_operator_is_imagined():
    laggy = LaggyOperator(policy, 1, EpisodeNoise([0]), 1)
    laggy.p, laggy.memory = (
        1.0,
        {"last": torch.tensor([[1.0]]), "started": torch.ones(1, 1, dtype=torch.bool)},
    )
    records = []
    for operator in (laggy, unimpaired()):  # who repeats full throttle runs into the hazard
        record = decided(ready(tau_c=9.0, tau_r=9.0), -0.3, 1.0, operator).record
        records.append(float(record.g_cost))
    assert records[0] == records[1]


def test_the_correction_is_the_least_of_its_force_and_without_another_force_there_is_none():
    """At x = -2 the expert commands 1; from .2 on every command is the same force."""
    settings = {"tau_c": 9.0, "tau_r": 0.0}
    wide, least = (
        decided(ready(**settings), -2.0, -0.5),
        decided(ready(COARSE, **settings), -2.0, -0.5),
    )
    assert float(wide.action) == pytest.approx(1.0)
    assert float(least.action) == pytest.approx(0.2, abs=1e-5)
    stands = decided(ready(COARSE, **settings), -2.0, 0.3)
    assert int(stands.record.gate) == GATE_NONE
    assert float(stands.action) == np.float32(0.3)
    assert int(decided(ready(**settings), -2.0, 0.3).record.gate) == GATE_TASK


def test_an_ended_episode_is_left_alone_and_changes_nothing_of_the_others():
    places, commands = [0.1, 0.25, -2.0], torch.tensor([[1.0], [0.9], [-0.9]])

    def run(resting: bool) -> list[Decision]:
        assistant = ready(rows=3, tau_c=0.3, tau_r=0.05)
        at = assistant.imagination.model.at(*places)
        found = []
        for _ in range(2):
            found.append(assistant.decide(at, commands, unimpaired(3)))
            if resting:
                assistant.rest(torch.tensor([False, True, False]))
        return found

    (_, awake), (_, resting) = run(False), run(True)
    assert int(resting.record.gate[1]) == GATE_NONE
    assert float(resting.action[1]) == np.float32(0.9)
    torch.testing.assert_close(resting.action[[0, 2]], awake.action[[0, 2]], rtol=0, atol=0)


def test_without_rollouts_one_step_and_both_critics_decide():
    assistant = ready(variant="no-rollout")
    assistant.tau_c, assistant.tau_r = 9.0, 9.0
    record = decided(assistant, 0.1, 1.0).record
    places = [0.1 + 0.1 + JITTER * shift for shift in drawn(SEED, 1)[0, :, 0].tolist()]
    cost = np.mean(
        [(1.0 if LOW < x < HIGH else 0.0) + GAMMA_C * GOES_ON * 0.25 * abs(x) for x in places]
    )
    reward = np.mean([0.1 + GAMMA_R * GOES_ON * 0.5 * x for x in places])
    assert float(record.g_cost) == pytest.approx(cost, abs=1e-5)
    assert float(record.g_return) == pytest.approx(reward, abs=1e-5)


@pytest.mark.parametrize(("motors", "share"), [(UNKNOWN, 1.0), (COARSE, 0.5)])
def test_tau_r_is_what_putting_right_a_random_command_gains_on_average(motors, share):
    count, tau_c = 70, 0.3
    places = torch.linspace(-1.0, 0.25, count).tolist()
    assistant = ready(motors, tau_c=tau_c, tau_r_share=share)
    zeros = torch.zeros(count)
    a_h = torch.tensor([[expert(x)] for x in places])
    heldout = Heldout(
        assistant.imagination.model.at(*places), a_h, zeros, zeros, zeros.long(), zeros
    )
    found = assistant.calibrate(heldout, zeros, unimpaired(count), 5)
    random = np.random.default_rng(5)
    gains = []
    for k in range(MISTAKES):
        commands = random.uniform(-1, 1, (count, 1)).astype(np.float32)[:, 0].tolist()
        for i, (x, command) in enumerate(zip(places, commands, strict=True)):
            noise = drawn(5 + k + i)
            target = float(motors.least(torch.tensor([command]), torch.tensor([expert(x)])))
            (g_r, g_c), (better, safer) = future(x, command, noise), future(x, target, noise)
            if target != command and max(g_c, safer) <= tau_c:
                gains.append(better - g_r)
    assert len(gains) > 100
    assert found["tau_r"] == pytest.approx(share * float(np.mean(gains)), abs=1e-5)
    assert assistant.tau_r == found["tau_r"]
    assert found["tau_c"] == tau_c
