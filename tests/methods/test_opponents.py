"""Opponents: with the least correction, IDA behind WASP's safety gate, and CSA in one step."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_latents
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods.base import Assistant, Decision, Heldout, Parts
from wasp_cli.methods.csa import CSA
from wasp_cli.metrics.episode import GATE_METHOD, GATE_NONE, GATE_SAFETY
from wasp_cli.models.base import Latent
from wasp_cli.models.consistency import sigma_at
from wasp_cli.operators.base import EpisodeNoise, Operator
from wasp_cli.tasks.motors import Motors

B, COARSE = 64, Motors((0.3, 0.3))
SMALL: dict[str, Any] = {
    "candidates": 12,
    "elites": 4,
    "feasible": 4,
    "iterations": 2,
    "rollouts": 2,
    "horizon": 6,
}
VOTE: dict[str, Any] = {"vote": 0.0}


@pytest.fixture
def parts(artifacts) -> Parts:
    return load_parts(artifacts, ReturnsConfig(), motors=COARSE)


def situation(parts: Parts) -> tuple[Latent, Tensor, Operator]:
    a_h = 2 * torch.rand((B, 2), generator=torch.Generator().manual_seed(0)) - 1
    return tiny_latents(B, 0), a_h, Operator(parts.skills.expert, 2, EpisodeNoise([0] * B), B)


def decided(assistant: Assistant, parts: Parts, command: Tensor | None = None) -> Decision:
    latent, a_h, operator = situation(parts)
    assistant.reset(torch.ones(B, dtype=torch.bool), list(range(B)))
    with torch.inference_mode():
        return assistant.decide(latent, a_h if command is None else command, operator)


def test_the_least_correction_has_the_force_of_the_copilot_and_the_rest_of_the_command(parts):
    a_h = situation(parts)[1]
    whole = decided(build_assistant("ida", VOTE, parts), parts)
    least = decided(build_assistant("ida-least", VOTE, parts), parts)
    assert torch.equal(least.action, COARSE.least(a_h, whole.action))
    force, wanted = (COARSE.force(each.action.numpy()) for each in (least, whole))
    np.testing.assert_allclose(force, wanted, atol=1e-6)
    same = torch.from_numpy(COARSE.force(a_h.numpy()) == wanted)
    assert torch.equal(least.action[same], a_h[same])
    assert same.any()
    assert (least.action - a_h).norm() < (whole.action - a_h).norm()


def test_ida_acts_alone_where_what_it_does_is_safe(parts):
    a_h = situation(parts)[1]
    ida = decided(build_assistant("ida", VOTE, parts), parts)
    guarded = decided(build_assistant("ida-guarded", SMALL | VOTE | {"tau_c": 1e6}, parts), parts)
    assert torch.equal(guarded.action, COARSE.least(a_h, ida.action))
    assert torch.equal(guarded.record.gate, ida.record.gate)
    assert set(guarded.record.gate.tolist()) == {GATE_NONE, GATE_METHOD}
    assert torch.equal(guarded.record.signal, ida.record.signal)


def test_the_safety_gate_looks_at_what_ida_decided(parts):
    a_h = situation(parts)[1]
    ida = decided(build_assistant("ida", VOTE, parts), parts)
    guarded = decided(build_assistant("ida-guarded", SMALL | VOTE | {"tau_c": 1e-9}, parts), parts)
    alone = build_assistant("wasp", SMALL | {"tau_c": 1e-9, "variant": "safety-only"}, parts)
    behind = decided(alone, parts, COARSE.least(a_h, ida.action))
    assert torch.equal(guarded.action, COARSE.least(a_h, behind.action))
    assert (guarded.record.gate == GATE_SAFETY).all()


def test_ida_behind_the_gate_has_idas_threshold(parts):
    latent, a_h, operator = situation(parts)
    nothing = torch.zeros(B)
    heldout = Heldout(latent, a_h, nothing, nothing, nothing, nothing)

    def calibrated(name: str, config: dict[str, Any]) -> dict[str, float]:
        assistant: Any = build_assistant(name, config, parts)
        with torch.inference_mode():
            return dict(assistant.calibrate(heldout, nothing, operator, 5))

    ida, least = calibrated("ida", VOTE), calibrated("ida-least", VOTE)
    guarded = calibrated("ida-guarded", SMALL | VOTE | {"tau_c": 2.0})
    assert least == ida
    assert guarded == ida | {"tau_c": 2.0}


ROWS = 5


@pytest.fixture
def commands() -> Tensor:
    return 2 * torch.rand(ROWS, 2, generator=torch.Generator().manual_seed(2)) - 1


def executed(made: CSA, commands: Tensor) -> tuple[Tensor, list[int]]:
    made.reset(torch.ones(len(commands), dtype=torch.bool), list(range(len(commands))))
    operator = Operator(lambda f: f[:, :2], 2, EpisodeNoise([0] * len(commands)), len(commands))
    decision = made.decide(tiny_latents(len(commands), 1), commands, operator)
    return decision.action, [] if decision.record is None else decision.record.gate.tolist()


def test_at_level_0_the_command_stands_bit_for_bit_and_nothing_intervened(parts, commands):
    action, gates = executed(build_assistant("csa", {"ratio": 0.0}, parts), commands)
    assert torch.equal(action, commands)
    assert gates == []


def test_the_command_itself_is_the_noisy_sample_and_one_evaluation_at_its_level_is_the_action(
    commands,
):
    asked: list[tuple[Tensor, Tensor]] = []

    def network(features: Tensor, noisy: Tensor, sigma: Tensor) -> Tensor:
        asked.append((noisy, sigma))
        return 3 * noisy

    made = object.__new__(CSA)
    made.ratio, made.model = 0.4, network
    action, _ = executed(made, commands)
    ((noisy, sigma),) = asked
    assert torch.equal(noisy, commands)
    assert sigma.tolist() == pytest.approx([sigma_at(0.4)] * ROWS)
    assert torch.equal(action, (3 * commands).clamp(-1, 1))
