"""Every registered assistant keeps the promises of `methods.base`."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_latents
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.methods.base import Assistant, Heldout, Parts
from wasp_cli.methods.record import blank_record
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator

ROWS, STEPS = 5, 4
SIZES = {
    "horizon": 4,
    "residual_steps": 2,
    "candidates": 12,
    "elites": 4,
    "feasible": 4,
    "iterations": 2,
    "rollouts": 2,
}
SMALL: dict[str, dict[str, Any]] = {
    "wasp": {**SIZES, "tau_c": 1.2},
    "printed": {**SIZES, "probe": 12, "tau_c": 1.2},
    "ida-guarded": {**SIZES, "tau_c": 1.2},
    "mpmi": {"horizon": 4, "candidates": 12, "rollouts": 2, "tau_c": 1.9},
    "planner": {**SIZES, "tau_c": 1.2},
}
OPTIONS: dict[str, list[dict[str, Any]]] = {
    "ida": [{"copilot": "diffusion"}],
    "diffusion": [{"last_noise": True}],
    "filter": [{"tau_c": 0.01}],
    "wasp": [{"adversary": "lucid"}],
}
"""Settings under which a method decides by other code."""
CASES = [(name, variant, {}) for name in METHODS for variant in METHODS[name].variants]
CASES += [(name, "full", settings) for name, several in OPTIONS.items() for settings in several]


def assistant(parts: Parts, name: str, variant: str, **changes: Any) -> Assistant:
    config = SMALL.get(name, {}) | changes
    return build_assistant(
        name, config | ({"variant": variant} if len(METHODS[name].variants) > 1 else {}), parts
    )


def operator(parts: Parts, rows: list[int]) -> Operator:
    return build_operator(
        "laggy",
        0.5,
        OperatorContext(parts.skills.at, 2, 0.08),
        EpisodeNoise([100 + r for r in rows]),
        len(rows),
    )


@torch.inference_mode()
def drive(parts: Parts, made: Assistant, rows: list[int]) -> tuple[Tensor, Tensor, list[Any]]:
    """Commands and actions [T, B, A] of a few decisions for some of the rows, and the decisions."""
    who = operator(parts, rows)
    made.reset(torch.ones(len(rows), dtype=torch.bool), [7 + r for r in rows])
    commands, actions, decisions = [], [], []
    for t in range(STEPS):
        latent = tiny_latents(ROWS, t).rows(torch.tensor(rows))
        a_h = who.command(latent.features).clamp(-1, 1)
        before = a_h.clone()
        decision = made.decide(latent, a_h, who)
        assert torch.equal(a_h, before), "an assistant must not change the command it was given"
        commands.append(before)
        actions.append(decision.action)
        decisions.append(decision)
    return torch.stack(commands), torch.stack(actions), decisions


@pytest.mark.parametrize(("name", "variant", "settings"), CASES)
def test_decisions_repeat_within_their_bounds_and_leave_commands_alone_where_no_gate_fired(
    parts, name, variant, settings
):
    made = assistant(parts, name, variant, **settings)
    commands, actions, decisions = drive(parts, made, list(range(ROWS)))
    assert torch.equal(actions, drive(parts, made, list(range(ROWS)))[1])
    silent = (
        torch.stack([(decision.record or blank_record(ROWS)).gate for decision in decisions]) == 0
    )
    assert torch.equal(actions[silent], commands[silent])
    assert actions.shape == commands.shape == (STEPS, ROWS, 2)
    assert torch.isfinite(actions).all()
    assert actions.abs().max() <= 1
    for decision in decisions:
        record = decision.record or blank_record(ROWS)
        assert all(field.shape == (ROWS,) for field in record)
        assert record.gate.dtype == torch.int8
        if decision.planned is not None:
            assert all(len(field) == ROWS for field in decision.planned)
            planned = decision.planned.safe[:, -1] >= 0
            assert torch.equal(planned, (record.gate == 1) | (record.gate == 2))
            assert decision.planned.residuals[planned].isfinite().all()
            assert decision.planned.residuals[~planned].isnan().all()


@pytest.mark.parametrize(("name", "variant", "settings"), CASES)
def test_an_episode_does_not_depend_on_those_beside_it(parts, name, variant, settings):
    _, together, _ = drive(parts, assistant(parts, name, variant, **settings), list(range(ROWS)))
    _, alone, _ = drive(parts, assistant(parts, name, variant, **settings), [3])
    torch.testing.assert_close(alone[:, 0], together[:, 3], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", [name for name in METHODS if METHODS[name].calibrated])
def test_calibration_gives_finite_thresholds(parts, name):
    rows = 30
    latent = tiny_latents(rows, 0)
    zeros = torch.zeros(rows)
    heldout = Heldout(
        latent, parts.skills.expert(latent.features), zeros, zeros, zeros.long(), zeros
    )
    who = Operator.build(
        1.0, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([0] * rows), rows
    )
    with torch.inference_mode():
        thresholds = assistant(parts, name, "full").calibrate(heldout, zeros, who, 3)
    wanted = {"ida": "tau_q", "ida-guarded": "tau_q", "wasp": "tau_r", "printed": "tau_r"}.get(name)
    assert wanted is None or torch.isfinite(torch.tensor(thresholds[wanted]))
