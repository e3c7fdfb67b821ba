"""A whole decision (Eq. 9-18) against a slow, literal reading of section 4, in float64, candidate by candidate and rollout by rollout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, LinearCritics
from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.assistant import WASP, effective
from wasp_cli.methods.wasp.candidates import Batch, propose
from wasp_cli.methods.wasp.gates import probe, scored_again
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.planner import plan_residuals
from wasp_cli.operators.base import DrawnNoise, Operator

GAMMA_R, GAMMA_C, LAM = 0.9, 0.8, 0.7
LOW, HIGH, JITTER = 0.3, 0.6, 0.05


def configured(**changes: Any) -> WASPConfig:
    sizes = {
        "horizon": 6, "residual_steps": 3, "candidates": 24, "probe": 24, "elites": 6, "feasible": 5, "iterations": 3, "rollouts": 2,
        "gate_rollouts": 3, "continuation": False, "takeover_shares": (), "probe_with": "random", "elites_kept": 0.0, "shrink": 1.0,
        "task_search": True, "safety_search": True, "alpha": 0.1, "tau_c": 0.5,
    }  # fmt: skip
    return WASPConfig.model_validate(sizes | changes)


def policy(features: Tensor) -> Tensor:
    return (0.9 - features[:, :1]).clamp(-1, 1)


@dataclass
class Literal:
    """One decision in plain numbers."""

    config: WASPConfig
    x: float
    a_h: float

    def rollout(self, residual: list[float], gumbel: Tensor) -> tuple[list[float], list[float], list[float], float]:
        """Rewards, costs, positions at the arrived states, and sum ||delta||^2 (Eq. 13)."""
        x, rewards, costs, positions, effort = self.x, [], [], [], 0.0
        for k in range(self.config.horizon):
            command = self.a_h if k == 0 else min(1.0, max(-1.0, 0.9 - x))
            action = command
            if k < self.config.residual_steps:
                action = min(1.0, max(-1.0, command + residual[k]))
                effort += (action - command) ** 2
            x = x + 0.1 * action + JITTER * float(gumbel[k, 0])
            positions.append(x)
            rewards.append(0.1 * action)
            costs.append(1.0 if LOW < x < HIGH else 0.0)
        return rewards, costs, positions, effort

    def returns(self, residual: list[float], draws: Tensor) -> tuple[float, float, float]:
        """Means over the M rollouts of `draws` [H, M, Z]: (G^(r), G^(c), effort), Eq. 7-10, 15."""
        total = [0.0, 0.0, 0.0]
        rollouts = draws.shape[1]
        for m in range(rollouts):
            rewards, costs, positions, effort = self.rollout(residual, draws[:, m])
            g_r, g_c = 0.5 * positions[-1], 0.25 * abs(positions[-1])  # Eq. 7
            for k in reversed(range(self.config.horizon)):  # Eq. 8
                g_r = rewards[k] + GAMMA_R * ((1 - LAM) * 0.5 * positions[k] + LAM * g_r)
                g_c = costs[k] + GAMMA_C * ((1 - LAM) * 0.25 * abs(positions[k]) + LAM * g_c)
            if not self.config.bootstrap_cost:
                g_c = sum(GAMMA_C**k * c for k, c in enumerate(costs))
            if not self.config.bootstrap_reward:
                g_r = sum(GAMMA_R**k * r for k, r in enumerate(rewards))
            total = [a + b / rollouts for a, b in zip(total, (g_r, g_c, effort), strict=True)]
        return total[0], total[1], total[2]

    def task(self, found: tuple[float, float, float]) -> float:
        """Eq. 16."""
        return found[0] - self.config.alpha * found[2]

    def safe(self, found: tuple[float, float, float], tau_c: float) -> float:
        """Eq. 17."""
        return max(0.0, found[1] - tau_c) + self.config.alpha * found[2]

    def corrected(self, candidates: list[list[float]], draws: Tensor, fresh: Tensor, tau_c: float) -> tuple[float, int | None]:
        """(Delta G of Eq. 12, index of Eq. 11's maximiser); minus infinity where no candidate is feasible."""
        best, score = None, -float("inf")
        for i, residual in enumerate(candidates):
            found = self.returns(residual, draws)
            if found[1] <= tau_c and self.task(found) > score:
                best, score = i, self.task(found)
        if best is None:
            return -float("inf"), None
        nothing = [0.0] * self.config.residual_steps
        return self.returns(candidates[best], fresh)[0] - self.returns(nothing, fresh)[0], best

    def plan(self, normals: Tensor, draws: Tensor, tau_c: float) -> tuple[list[float], list[int]]:
        """The sequence that section 4.3 selects and |F_s| of every iteration; `normals` [I, N, L]."""
        config, steps = self.config, self.config.residual_steps
        mean, std = [0.0] * steps, [config.initial_std] * steps
        best_task, best_safe, counts = (-float("inf"), [0.0] * steps), (float("inf"), [0.0] * steps), []
        for i, batch in enumerate(normals):
            candidates = [[min(2.0, max(-2.0, mean[k] + std[k] * float(n[k]))) for k in range(steps)] for n in batch]
            candidates[0 if i == 0 else 1] = [0.0] * steps if i == 0 else list(mean)
            found = [self.returns(candidate, draws) for candidate in candidates]
            safe = [i for i, each in enumerate(found) if each[1] <= tau_c]  # Eq. 14
            counts.append(len(safe))
            for i, each in enumerate(found):
                if i in safe and self.task(each) > best_task[0]:
                    best_task = (self.task(each), candidates[i])
                if self.safe(each, tau_c) < best_safe[0]:
                    best_safe = (self.safe(each, tau_c), candidates[i])
            if len(safe) >= config.feasible:  # Case I
                elites = sorted(safe, key=lambda i: -self.task(found[i]))[: config.elites]
            else:  # Case II
                elites = sorted(range(len(found)), key=lambda i: self.safe(found[i], tau_c))[: config.feasible]
            for k in range(steps):
                values = [candidates[i][k] for i in elites]
                centre = sum(values) / len(values)
                spread = (sum((v - centre) ** 2 for v in values) / len(values)) ** 0.5
                mean[k] = config.momentum * mean[k] + (1 - config.momentum) * centre
                std[k] = max(spread, config.std_floor)
        return (best_task if best_task[0] > -float("inf") else best_safe)[1], counts


def imagined(config: WASPConfig) -> Imagination:
    return Imagination(Corridor(LOW, HIGH, JITTER, torch.float64), LinearCritics(), config, GAMMA_R, GAMMA_C, LAM)


def deciding(config: WASPConfig) -> WASP:
    """An assistant in float32, which is what it runs in."""
    return WASP(config, Imagination(Corridor(LOW, HIGH, JITTER), LinearCritics(), effective(config), GAMMA_R, GAMMA_C, LAM), {})


def situation(imagination: Imagination, x: float, a_h: float) -> Situation:
    operator = Operator(policy, 1, DrawnNoise(torch.zeros(1, 1, 0)), 1)
    latent = imagination.model.at(x)  # type: ignore[attr-defined]
    return Situation(latent, torch.tensor([[a_h]], dtype=latent.h.dtype), operator, torch.arange(1))


def drawn(seed: int, horizon: int, rollouts: int) -> Draws:
    source = torch.Generator().manual_seed(seed)
    return Draws(torch.randn(1, horizon, rollouts, 2, generator=source, dtype=torch.float64), torch.zeros(1, horizon, rollouts, 0))


CORNERS: dict[str, dict[str, Any]] = {
    "as configured": {}, "horizon is residual_steps": {"horizon": 3}, "one rollout": {"rollouts": 1},
    "cost bootstrapped": {"bootstrap_cost": True}, "reward not bootstrapped": {"bootstrap_reward": False},
    "bounds hit": {"initial_std": 3.0}, "single step": {"horizon": 1, "residual_steps": 1},
}  # fmt: skip


@pytest.mark.parametrize("changes", CORNERS.values(), ids=CORNERS)
@pytest.mark.parametrize(("x", "a_h", "tau_c"), [(0.0, 1.0, 0.3), (0.2, 0.9, 0.3), (0.45, 0.1, 0.3), (0.45, 0.1, 1e-6), (-2.0, 0.3, 0.3)])
def test_search_and_gates_equal_their_literal_reading(changes: dict[str, Any], x: float, a_h: float, tau_c: float) -> None:
    config = configured(**changes)
    imagination, start = imagined(config), situation(imagined(config), x, a_h)
    literal = Literal(config, x, a_h)
    draws, fresh = drawn(0, config.horizon, config.rollouts), drawn(1, config.horizon, config.gate_rollouts)
    source = torch.Generator().manual_seed(2)
    shape = (1, config.iterations, config.candidates, config.residual_steps, 1)
    normals = torch.randn(shape, generator=source, dtype=torch.float64)

    nominal = imagination.nominal(start, draws)  # Eq. 9, 10
    nothing = [0.0] * config.residual_steps
    assert (nominal.reward.item(), nominal.cost.item(), nominal.effort.item()) == pytest.approx(literal.returns(nothing, draws.latent[0]))

    zeros = torch.zeros(1, config.residual_steps, 1, dtype=torch.float64)
    candidates = propose(zeros, torch.full_like(zeros, config.initial_std), normals[:, 0])
    batch = Batch(candidates, None, imagination.returns(start, candidates, draws))
    gain = probe(batch, nominal.reward, config, tau_c)  # Eq. 11, 12
    gain = scored_again(imagination, start, batch, gain, fresh)
    delta_g, best = literal.corrected(candidates[0, :, :, 0].tolist(), draws.latent[0], fresh.latent[0], tau_c)
    assert gain.delta_g.item() == pytest.approx(delta_g)
    assert best is None or int(gain.best) == best

    found = plan_residuals(imagination, start, zeros, normals, draws, tau_c)  # Eq. 13-17
    residuals, counts = literal.plan(normals[0, :, :, :, 0], draws.latent[0], tau_c)
    assert found.safe[0].tolist() == counts
    # Beyond the bounds many sequences are one and the same action, so sequences are compared by what they score.
    chosen, wanted = (literal.returns(each, draws.latent[0]) for each in (found.residuals[0, :, 0].tolist(), residuals))
    assert bool(found.found_safe) == (wanted[1] <= tau_c)
    if bool(found.found_safe):
        assert literal.task(chosen) == pytest.approx(literal.task(wanted))
    else:
        assert literal.safe(chosen, tau_c) == pytest.approx(literal.safe(wanted, tau_c))
    assert (found.predicted.reward.item(), found.predicted.cost.item(), found.predicted.effort.item()) == pytest.approx(chosen)
    assert found.case2[0].tolist() == [count < config.feasible for count in counts]


def counts_over_corners() -> list[int]:
    config = configured()
    counts = []
    for x, a_h, tau_c in [(0.45, 0.1, 1e-6), (-2.0, 0.3, 0.3)]:
        source = torch.Generator().manual_seed(2)
        normals = torch.randn(3, 24, 3, generator=source, dtype=torch.float64)
        counts += Literal(config, x, a_h).plan(normals, drawn(0, 6, 2).latent[0], tau_c)[1]
    return counts


def test_the_corners_above_hold_none_and_all_safe() -> None:
    assert 0 in counts_over_corners()
    assert 24 in counts_over_corners()


@pytest.mark.parametrize("missing", [0, 1])
def test_exactly_enough_safe_candidates_are_case_1_and_one_fewer_is_case_2(missing: int) -> None:
    """The elites of Case I are the safe ones; those of Case II the ones of least S_safe, safe or not."""
    config = configured(iterations=2, finalists=0)

    class Counted(Imagination):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            index = torch.arange(residuals.shape[1], dtype=torch.float64).expand(residuals.shape[:2])
            cost = (index >= config.feasible - missing).to(index.dtype)
            return Returns(index, cost, residuals.square().sum((-2, -1)))

    model = Counted(Corridor(9, 9), LinearCritics(), config, GAMMA_R, GAMMA_C, LAM)
    start = situation(imagined(config), 0.0, 0.0)
    normals = torch.randn(1, 2, 24, 3, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    zeros = torch.zeros(1, 3, 1, dtype=torch.float64)
    found = plan_residuals(model, start, zeros, normals, drawn(0, 6, 2), 0.3)
    assert found.safe[0].tolist() == [config.feasible - missing] * 2
    assert found.case2[0].tolist() == [bool(missing)] * 2


def test_the_executed_action_is_clipped_as_imagined() -> None:
    """Eq. 18, by a plan that asks for more than the bounds allow."""
    config = configured(initial_std=5.0, alpha=0.0, recheck=False)
    assistant = deciding(config)
    assistant.reset(torch.ones(1, dtype=torch.bool), [5])
    start = situation(assistant.imagination, 0.28, 1.0)
    decision = assistant.decide(start.latent, start.a_h, start.operator)
    assert decision.record is not None
    assert decision.planned is not None
    assert int(decision.record.gate) == 1
    first = decision.planned.residuals[0, 0]
    assert float(first) < -1.0
    assert decision.action[0].item() == pytest.approx(max(-1.0, 1.0 + float(first)))


def test_a_decision_has_the_order_of_section_4(monkeypatch: pytest.MonkeyPatch) -> None:
    """Safety first; the task gate is asked only when it is silent; the probe that fires is the first iteration of the search."""
    seen: list[int] = []
    original: Callable[..., Any] = Imagination.rolled

    def counted(self: Imagination, start: Situation, residuals: Tensor, draws: Draws, *rest: Any, **further: Any) -> Any:
        seen.append(residuals.shape[1])
        return original(self, start, residuals, draws, *rest, **further)

    monkeypatch.setattr(Imagination, "rolled", counted)
    config = configured(probe=20, finalists=2)
    for x, tau_r, gate, batches in [
        (0.28, 0.0, 1, [1, 24, 24, 24, 6]),  # nominal, three iterations, the finalists
        (-2.0, 1e9, 0, [1, 20]),  # nominal, probe
        (-2.0, -1e9, 2, [1, 20, 2, 24, 24, 6]),  # its winner beside nothing, and two further iterations
    ]:
        assistant = deciding(config.model_copy(update={"tau_r": tau_r}))
        assistant.reset(torch.ones(1, dtype=torch.bool), [3])
        start = situation(assistant.imagination, x, 0.8)
        seen.clear()
        decision = assistant.decide(start.latent, start.a_h, start.operator)
        assert decision.record is not None
        assert int(decision.record.gate) == gate
        assert seen == batches


def test_draws_of_the_gate_are_those_of_the_search() -> None:
    """Common random numbers: the candidate without residual has the nominal cost, so that the gate's alarm is the planner's."""
    config = configured(rollouts=3)
    imagination = imagined(config)
    start = situation(imagination, 0.28, 1.0)
    draws = drawn(4, 6, 3)
    normals = torch.from_numpy(np.random.default_rng(0).standard_normal((1, 24, 3, 1)))
    candidates = propose(torch.zeros(1, 3, 1).double(), torch.ones(1, 3, 1).double(), normals)
    assert imagination.returns(start, candidates, draws).cost[0, 0] == imagination.nominal(start, draws).cost[0]
