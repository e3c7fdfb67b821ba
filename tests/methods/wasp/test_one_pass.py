"""Gates and search run without a look at a number: nothing inside depends on the values of tensors, so one pass serves a CUDA graph."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, DynamicOutputShapeException, FakeTensorMode

from wasp_cli.learning.configs import WorldModelConfig
from wasp_cli.learning.world_model import build
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.candidates import Batch, propose, takeovers
from wasp_cli.methods.wasp.gates import probe, scored_again
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation
from wasp_cli.methods.wasp.planner import plan_residuals
from wasp_cli.models.critics import LatentCritics
from wasp_cli.models.policy import Skills
from wasp_cli.operators.base import DrawnNoise, OperatorContext, build_operator

B, H, L, A, N, M = 3, 4, 2, 2, 12, 2
SMALL = WorldModelConfig(deter=16, hidden=16, variables=4, classes=4, depth=2, head=16)
SIZES: dict[str, Any] = {
    "horizon": H, "residual_steps": L, "candidates": N, "probe": N, "elites": 4, "feasible": 4, "iterations": 3,
    "rollouts": M, "gate_rollouts": M, "takeover_rollouts": M,
}  # fmt: skip


def test_values_decide_nothing_about_the_course_of_a_search() -> None:
    """Fake tensors have shapes and no values: whatever asked for one would raise."""
    with FakeTensorMode():
        with pytest.raises((DataDependentOutputException, DynamicOutputShapeException)):
            bool(torch.zeros(1).sum() > 0)
        for operator in ("noisy", "laggy", "reaction-time"):
            for variant in ("full", "no-case2"):
                _decide(operator, WASPConfig.model_validate(SIZES | {"variant": variant}))


def _taken(imagination: Imagination, start: Situation, share: torch.Tensor, draws: Draws) -> Any:
    returns, realised = imagination.rolled(start, torch.zeros(*share.shape[:3], A), draws, share)
    return realised, share, returns


def _decide(variant: str, config: WASPConfig) -> None:
    model = build(SMALL, A)
    skills = Skills([1.0], model.feature_size, [8], A)
    context = OperatorContext(skill=skills.at, action_size=A, decision_seconds=0.1)
    operator = build_operator(variant, 0.4, context, DrawnNoise(torch.zeros(1, B, 3)), B)
    imagination = Imagination(model, LatentCritics(model.feature_size, [8]), config, 0.99, 0.95, 0.95, skills.expert)
    start = Situation(model.initial(B), torch.zeros(B, A), operator, torch.arange(B))
    draws = Draws(torch.zeros(B, H, M, model.noise_size), torch.zeros(B, H, M, operator.draws))
    mean = torch.zeros(B, L, A)
    with torch.no_grad():
        nominal = imagination.nominal(start, draws)
        candidates = propose(mean, torch.ones_like(mean), torch.zeros(B, N, L, A), mean)
        share = takeovers(config, B)
        taken = Batch(*_taken(imagination, start, share, draws))
        gain = scored_again(imagination, start, taken, probe(taken, nominal.reward, config, 0.3), draws)
        first = Batch(candidates, None, imagination.returns(start, candidates, draws))
        normals = torch.zeros(B, config.iterations, N, L, A)
        plan = plan_residuals(imagination, start, mean, normals, draws, 0.3, first=first, besides=taken, fresh=draws, kept=mean)
    assert nominal.cost.shape == gain.delta_g.shape == (B,)
    assert plan.residuals.shape == (B, L, A)
    assert plan.safe.shape == (B, config.iterations)
