from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation
from wasp_cli.operators.base import DrawnNoise, Operator
from wasp_cli.operators.laggy import LaggyOperator

H, L, M, N, B = 6, 3, 2, 4, 3


def small(**changes: object) -> WASPConfig:
    sizes = {"horizon": H, "residual_steps": L, "candidates": 8, "elites": 2, "feasible": 2, "iterations": 2, "probe": 8, "rollouts": M}
    return WASPConfig.model_validate(sizes | changes)


def imagination(config: WASPConfig, jitter: float = 0.05) -> Imagination:
    return Imagination(Corridor(0.3, 0.6, jitter, torch.float64), LinearCritics(), config, 0.9, 0.8, 0.7)


def laggy(p: float) -> LaggyOperator:
    def policy(features: Tensor) -> Tensor:
        return (1.2 - features[:, :1]).clamp(-1, 1)

    operator = LaggyOperator(policy, 1, DrawnNoise(torch.zeros(1, B, 1, dtype=torch.float64)), B)
    operator.p = p
    operator.memory = {"last": torch.tensor([[0.2], [-0.4], [0.9]], dtype=torch.float64), "started": torch.ones(B, 1, dtype=torch.bool)}
    return operator


def literal(
    config: WASPConfig, x: float, a_h: float, last: float, p: float, residual: list[float], gumbels: Tensor, uniforms: Tensor
) -> tuple[float, float, float]:
    """One candidate and one rollout, step by step, in plain numbers: (G^(r), G^(c), effort)."""
    rewards, costs, positions, effort = [], [], [], 0.0
    for k in range(config.horizon):
        if k == 0:
            command = a_h
        else:
            intended = min(1.0, max(-1.0, 1.2 - x))
            command = last if float(uniforms[k - 1, 0]) < p else intended
            last = command
        action = command
        if k < config.residual_steps:
            base = a_h if config.composition == "hold" else command
            action = min(1.0, max(-1.0, base + residual[k]))
            effort += (action - base) ** 2
        x = x + 0.1 * action + 0.05 * float(gumbels[k, 0])
        positions.append(x)
        rewards.append(0.1 * action)
        costs.append(float(0.3 < x < 0.6))
    g_r, g_c = 0.5 * positions[-1], 0.25 * abs(positions[-1])
    for k in reversed(range(config.horizon)):
        g_r = rewards[k] + 0.9 * (0.3 * 0.5 * positions[k] + 0.7 * g_r)
        g_c = costs[k] + 0.8 * (0.3 * 0.25 * abs(positions[k]) + 0.7 * g_c)
    if not config.bootstrap_cost:
        g_c = sum(0.8**k * c for k, c in enumerate(costs))
    if not config.bootstrap_reward:
        g_r = sum(0.9**k * r for k, r in enumerate(rewards))
    return g_r, g_c, effort


@pytest.mark.parametrize("composition", ["per_step", "hold"])
@pytest.mark.parametrize("bootstrap", ["neither", "cost", "reward"])
def test_returns_of_every_candidate_equal_the_literal_rollout(composition: str, bootstrap: str) -> None:
    config = small(composition=composition, bootstrap_cost=bootstrap == "cost", bootstrap_reward=bootstrap == "reward")
    source = torch.Generator().manual_seed(0)
    residuals = 1.5 * torch.randn(B, N, L, 1, generator=source, dtype=torch.float64)
    draws = Draws(
        torch.randn(B, H, M, 2, generator=source, dtype=torch.float64), torch.rand(B, H, M, 1, generator=source, dtype=torch.float64)
    )
    operator = laggy(0.5)
    a_h = operator.memory["last"].clone()
    positions = (0.0, 0.2, 0.5)
    start = Situation(imagination(config).model.at(*positions), a_h, operator, torch.arange(B))  # type: ignore[attr-defined]
    found = imagination(config).returns(start, residuals, draws)
    for b in range(B):
        for n in range(N):
            rows = [
                literal(
                    config, positions[b], float(a_h[b]), float(a_h[b]), 0.5, residuals[b, n, :, 0].tolist(), draws.latent[b, :, m],
                    draws.operator[b, :, m],
                )
                for m in range(M)
            ]  # fmt: skip
            wanted = torch.tensor(rows, dtype=torch.float64).mean(0)
            got = torch.stack([found.reward[b, n], found.cost[b, n], found.effort[b, n]])
            torch.testing.assert_close(got, wanted)


def test_nominal_equals_the_candidate_without_residual() -> None:
    config = small()
    draws = Draws(torch.randn(B, H, M, 2, dtype=torch.float64), torch.rand(B, H, M, 1, dtype=torch.float64))
    operator = laggy(0.3)
    model = imagination(config)
    start = Situation(model.model.at(0.0, 0.1, 0.2), operator.memory["last"].clone(), operator, torch.arange(B))  # type: ignore[attr-defined]
    nominal = model.nominal(start, draws)
    candidates = torch.cat([torch.randn(B, 1, L, 1, dtype=torch.float64), torch.zeros(B, 1, L, 1, dtype=torch.float64)], 1)
    found = model.returns(start, candidates, draws)
    torch.testing.assert_close(nominal.reward, found.reward[:, 1])
    torch.testing.assert_close(nominal.cost, found.cost[:, 1])
    assert (nominal.effort == 0).all()


def test_imagining_leaves_the_real_operator_alone() -> None:
    operator = laggy(0.3)
    before = {name: value.clone() for name, value in operator.memory.items()}
    model = imagination(small())
    start = Situation(model.model.at(0.0, 0.1, 0.2), operator.memory["last"].clone(), operator, torch.arange(B))  # type: ignore[attr-defined]
    model.nominal(start, Draws(torch.zeros(B, H, M, 2, dtype=torch.float64), torch.zeros(B, H, M, 1, dtype=torch.float64)))
    assert all(torch.equal(before[name], operator.memory[name]) for name in before)
    assert isinstance(operator, Operator)


def test_nominal_rollouts_follow_the_operator_whatever_the_composition() -> None:
    """Eq. 9-10 know no correction, so that nothing is held, while a candidate without residual is a held command in Eq. 13 as printed."""
    draws = Draws(torch.randn(B, H, M, 2, dtype=torch.float64), torch.rand(B, H, M, 1, dtype=torch.float64))
    operator = laggy(0.3)
    found = []
    for composition in ("per_step", "hold"):
        model = imagination(small(composition=composition))
        start = Situation(model.model.at(0.0, 0.1, 0.2), operator.memory["last"].clone(), operator, torch.arange(B))  # type: ignore[attr-defined]
        found.append(model.nominal(start, draws))
    torch.testing.assert_close(found[0], found[1])
    held = model.returns(start, torch.zeros(B, 1, L, 1, dtype=torch.float64), draws)
    assert (held.reward.squeeze(1) != found[1].reward).all()


def test_effort_counts_what_is_executed_or_what_was_sampled() -> None:
    draws = Draws(torch.zeros(B, H, M, 2, dtype=torch.float64), torch.ones(B, H, M, 1, dtype=torch.float64))
    residuals = torch.full((B, 1, L, 1), 2.0, dtype=torch.float64)
    for effort, wanted in (("clipped", [0.8**2, 1.4**2, 0.1**2]), ("sampled", [4.0, 4.0, 4.0])):
        operator = laggy(0.0)
        model = imagination(small(effort=effort, residual_steps=1), 0.0)
        start = Situation(model.model.at(0.0, 0.1, 0.2), operator.memory["last"].clone(), operator, torch.arange(B))  # type: ignore[attr-defined]
        found = model.returns(start, residuals[:, :, :1], draws).effort.squeeze(1)
        torch.testing.assert_close(found, torch.tensor(wanted, dtype=torch.float64))


def test_one_gamma_is_that_of_the_rewards_or_of_the_costs() -> None:
    assert [imagination(small(discounts=name)).discounts for name in ("two", "reward", "cost")] == [(0.9, 0.8), (0.9, 0.9), (0.8, 0.8)]
