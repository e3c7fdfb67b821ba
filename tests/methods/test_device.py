"""Decisions on another device: no look at a number, fixed shapes whose masks give what gathered
rows give, and the same draws.
"""

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.artifacts import tiny_latents
from wasp_cli.drive import view
from wasp_cli.learning.assistants import build_assistant, load_parts
from wasp_cli.learning.configs import ReturnsConfig
from wasp_cli.methods import filter as safety_filter
from wasp_cli.methods.base import Assistant, Decision, Parts
from wasp_cli.methods.noise import DecisionNoise
from wasp_cli.methods.wasp import assistant as wasp
from wasp_cli.methods.wasp import printed
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.tasks.make import make_task

B = 5
EVERYONE = torch.ones(B, dtype=torch.bool)
METHODS: dict[str, dict[str, Any]] = {
    "wasp": {
        "candidates": 12,
        "elites": 4,
        "feasible": 4,
        "iterations": 2,
        "rollouts": 2,
        "horizon": 6,
    },
    "printed": {
        "candidates": 12,
        "elites": 4,
        "feasible": 4,
        "iterations": 2,
        "probe": 12,
        "rollouts": 2,
        "horizon": 6,
    },
    "ida": {"vote": 0.0, "copilot": "diffusion"},
    "halfway:Halfway": {},
    "diffusion": {},
    "saferl": {},
    "filter": {"candidates": 8, "segment": 4, "rollouts": 2},
    "human": {},
}
VARIANTS = ("safety-only", "no-case2", "no-rollout")
CASES = [
    *((name, {}) for name in METHODS),
    *(("wasp", {"variant": variant}) for variant in VARIANTS),
    ("printed", {"variant": "no-case2"}),
]
NOWHERE = [
    *((name, {}, "laggy") for name in METHODS),
    ("wasp", {"variant": "no-case2"}, "noisy"),
    ("printed", {}, "reaction-time"),
]


def made(
    parts: Parts, method: str, changes: dict[str, Any], variant: str = "laggy"
) -> tuple[Assistant, Operator]:
    assistant = build_assistant(method, METHODS[method] | changes, parts)
    context = OperatorContext(parts.skills.at, 2, 0.08)
    operator = build_operator(variant, 0.4, context, EpisodeNoise(list(range(B))), B).to(
        parts.device
    )
    assistant.reset(EVERYONE, [10 + b for b in range(B)])
    return assistant, operator


def decide(
    parts: Parts, method: str, changes: dict[str, Any], tau: tuple[float, float] | None
) -> list[Decision]:
    """Three decisions in a row; `tau` = thresholds of WASP and the filter, chosen so that some
    rows fire.
    """
    assistant, operator = made(parts, method, changes)
    if tau is not None:
        assistant.tau_c, assistant.tau_r = tau
    latent, found = tiny_latents(B, 0).to(parts.device), []
    with torch.inference_mode():
        for _ in range(3):
            a_h = operator.command(latent.features).clamp(-1, 1)
            found.append(assistant.decide(latent, a_h, operator))
    return found


@pytest.mark.parametrize(("method", "changes", "operator"), NOWHERE)
def test_no_assistant_looks_at_a_number_on_another_device(artifacts, method, changes, operator):
    """Tensors that have shapes and no values: what asks for one raises, and so does a tensor of
    the CPU among them.
    """
    nowhere = torch.device("meta")
    for look in (
        lambda x: bool(x.sum() > 0),
        lambda x: x.numpy(),
        lambda x: x.nonzero(),
        lambda x: x + torch.zeros(2),
    ):
        with pytest.raises((RuntimeError, NotImplementedError, TypeError)):
            look(torch.zeros(2, device=nowhere))
    parts = load_parts(artifacts, ReturnsConfig(), nowhere)
    assistant, issuing = made(parts, method, changes, operator)
    latent = tiny_latents(B, 0).to(nowhere)
    with torch.inference_mode():
        for _ in range(2):
            a_h = issuing.command(latent.features).clamp(-1, 1)
            decision = assistant.decide(latent, a_h, issuing)
    assert decision.action.shape == (B, 2)
    for field in (decision.action, *(decision.record or ()), *(decision.planned or ())):
        assert field.device == nowhere


MASKED = {"wasp": wasp, "printed": printed, "filter": safety_filter}


def everything(mask: Tensor) -> Tensor:
    return torch.arange(len(mask))


def thresholds(parts: Parts, method: str, changes: dict[str, Any]) -> tuple[float, float]:
    """tau_c and tau_r that about half of the rows exceed; the filter has one threshold, of its
    signal.
    """
    records = [d.record for d in decide(parts, method, changes, (1e9, 1e9)) if d.record is not None]
    if method == "filter":
        return float(torch.cat([record.signal for record in records]).median()), 0.0
    costs, gains = (
        torch.cat([record.g_cost for record in records]),
        torch.cat([record.delta_g for record in records]),
    )
    gains = gains[gains.isfinite()].sort().values
    # between two of them
    return float(costs.quantile(0.6)), float(gains[len(gains) // 2 - 1 :][:2].mean()) if len(
        gains
    ) else 0.0


@pytest.mark.parametrize(("method", "changes"), [case for case in CASES if case[0] in MASKED])
def test_masks_over_all_rows_decide_what_gathered_rows_do(parts, method, changes, monkeypatch):
    tau = thresholds(parts, method, changes)
    gathered = decide(parts, method, changes, tau)
    monkeypatch.setattr(MASKED[method], "chosen", everything)
    same(decide(parts, method, changes, tau), gathered)
    gates = torch.cat([d.record.gate for d in gathered if d.record is not None])
    assert (gates == 0).any()
    assert (gates > 0).any()


def same(found: list[Decision], wanted: list[Decision]) -> None:
    """Every field of every decision, up to the rounding of products of other sizes."""
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one.record.gate, other.record.gate)
        fields = zip(
            (one.action, *one.record, *(one.planned or ())),
            (other.action, *other.record, *(other.planned or ())),
            strict=True,
        )
        for mine, theirs in fields:
            torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4, equal_nan=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU")
@pytest.mark.parametrize(("method", "changes"), CASES)
def test_a_gpu_decides_what_the_cpu_does(artifacts, parts, method, changes):
    """The same draws and weights; only sums are in another order: 1e-4 of every number that
    leads to a decision.
    """
    tau = thresholds(parts, method, changes) if method in ("wasp", "printed") else None
    there = load_parts(artifacts, ReturnsConfig(), torch.device("cuda"))
    found = decide(there, method, changes, tau)
    wanted = decide(parts, method, changes, tau)
    if wanted[0].record is not None:
        same([on_cpu(decision) for decision in found], wanted)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one.action.cpu(), other.action, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
        ),
    ],
)
def test_whoever_drives_sees_what_is_imagined_on_any_device(artifacts, device, monkeypatch):
    monkeypatch.setattr(view, "DECISIONS", 4)
    parts = load_parts(artifacts, ReturnsConfig(), torch.device(device))
    assistant, operator = made(parts, "wasp", {})
    futures = view.Futures(
        "race1", parts, assistant, make_task("race1", 1, action_repeat=20, observe=("pixels",))
    )
    latent, a_h = parts.world_model.initial(1), torch.full((1, 2), 0.5, device=device)
    lines = futures.lines(0, latent, a_h, operator, Decision(-a_h), [0.0, 0.0, 0.0], 1.0)
    assert {name: len(line) for name, line in lines.items()} == {"alone": 7, "corrected": 7}


def on_cpu(decision: Decision) -> Decision:
    record, planned = decision.record, decision.planned
    return Decision(
        decision.action.cpu(),
        None if record is None else type(record)(*(field.cpu() for field in record)),
        None if planned is None else type(planned)(*(field.cpu() for field in planned)),
    )


@pytest.mark.parametrize(
    "drawn",
    [
        lambda streams: streams.uniform((4, 3), (2,), purpose=2),
        lambda streams: [streams.normal(3, 2, purpose=1)],
    ],
)
def test_draws_made_ahead_are_those_of_each_decision(drawn, monkeypatch):
    """On another device the draws of many decisions are made at once; which those are must not
    change them.
    """
    seeds, everyone = [3, 4, 5], torch.ones(3, dtype=torch.bool)
    monkeypatch.setattr("wasp_cli.methods.noise.AHEAD", 4)
    each, ahead = DecisionNoise(), DecisionNoise()
    ahead.device = torch.device("meta")
    monkeypatch.setattr(Tensor, "to", lambda self, *_: self)
    each.reset(everyone, seeds)
    ahead.reset(everyone, seeds)
    calls = []
    make = ahead.draw
    monkeypatch.setattr(
        ahead, "draw", lambda *a, make=make, calls=calls: calls.append(1) or make(*a)
    )
    for _ in range(9):
        for mine, theirs in zip(drawn(ahead.streams()), drawn(each.streams()), strict=True):
            assert torch.equal(mine, theirs)
    assert len(calls) == 12  # three blocks of four decisions
    some = torch.tensor([True, False, True])
    ahead.reset(some, [7, 8, 9])
    each.reset(some, [7, 8, 9])
    for mine, theirs in zip(drawn(ahead.streams()), drawn(each.streams()), strict=True):
        assert torch.equal(mine, theirs)
