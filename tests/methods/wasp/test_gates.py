"""Where the gates draw their lines, and what a decision leaves to the next one. B decisions, N candidates, L residual steps, K held-out."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from tests.worlds import Corridor, NoCritics
from wasp_cli.methods.configs import Coverage, WASPConfig
from wasp_cli.methods.wasp.assistant import WASP
from wasp_cli.methods.wasp.candidates import Batch
from wasp_cli.methods.wasp.gates import Signals, probe, safety_gate
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Returns, Situation
from wasp_cli.methods.wasp.planner import Plan, plan_residuals
from wasp_cli.operators.base import DrawnNoise, Operator

L = 4
NAN, INF = float("nan"), float("inf")


def config(**changes: Any) -> WASPConfig:
    sizes = {"horizon": 5, "residual_steps": L, "candidates": 8, "elites": 2, "feasible": 2, "iterations": 2, "finalists": 2}
    return WASPConfig.model_validate(sizes | {"tau_c": 0.5, "tau_r": 1.0} | changes)


def assistant(**changes: Any) -> WASP:
    """Of two rows, at the start of their episodes."""
    made = config(**changes)
    found = WASP(made, Imagination(Corridor(9, 9), NoCritics(), made, 0.9, 0.9, 0.9), {})
    found.reset(torch.ones(2, dtype=torch.bool), [1, 2])
    return found


def returns(reward: list[float], cost: list[float]) -> Returns:
    return Returns(torch.tensor(reward), torch.tensor(cost), torch.zeros(len(cost)))


def test_a_cost_of_exactly_tau_c_is_allowed_by_both_gates_and_by_the_search() -> None:
    """Eq. 9 asks for more than tau_c, Eq. 11 and 14 for no more than it."""
    above = 0.5 + 2**-20
    assert safety_gate(returns([0.0] * 3, [0.49, 0.5, above]), config(), 0.5).tolist() == [False, False, True]
    candidates = Batch(torch.zeros(2, 1, L, 1), None, Returns(torch.ones(2, 1), torch.tensor([[0.5], [above]]), torch.zeros(2, 1)))
    assert probe(candidates, torch.zeros(2), config(), 0.5).delta_g.tolist() == [1.0, -INF]

    class Level(Imagination):
        def returns(self, start: Situation, residuals: Tensor, draws: Draws, share: Tensor | None = None, *, alone: int = 0) -> Returns:
            effort = residuals.square().sum((-2, -1))
            return Returns(-effort, torch.full_like(effort, 0.5), effort)

    zeros = torch.zeros(1, L, 1)
    start = Situation(
        Corridor(9, 9).at(0.0), zeros[:, 0], Operator(lambda f: f * 0, 1, DrawnNoise(torch.zeros(1, 1, 0)), 1), torch.arange(1)
    )
    draws = Draws(torch.zeros(1, 5, 1, 2), torch.zeros(1, 5, 1, 0))
    normals = torch.randn(1, 2, 8, L, 1, generator=torch.Generator().manual_seed(0))
    for tau_c, safe in ((0.5, True), (0.5 - 2**-20, False)):
        plan = plan_residuals(
            Level(Corridor(9, 9), NoCritics(), config(elites_kept=0.0, shrink=1.0), 0.9, 0.9, 0.9), start, zeros, normals, draws, tau_c
        )
        assert bool(plan.found_safe) is safe
        assert plan.safe.tolist() == [[8.0 * safe] * 2]


def test_tau_c_comes_from_harmless_decisions_and_tau_r_from_quiet_ones() -> None:
    cost = torch.tensor([0.1, 0.2, 0.3, 0.4, 5.0, 6.0])
    signals = Signals(cost, 10 * cost, torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0, NAN]))  # the last two cost something, or nobody knows
    halves: dict[str, Any] = {"tau_c_quantile": 0.5, "tau_r_quantile": 0.5, "tau_r_floor": 0.0}
    made = config(tau_c="calibrated", **halves)
    assert signals.tau_c(made, 9.0) == pytest.approx(0.25)
    assert signals.tau_c(config(), 9.0) == 0.5
    assert signals.tau_c(config(tau_c=Coverage()), 9.0) == 9.0
    # A single step has another unit: as many decisions as 2.5 lets through of the whole method's signals, a third of them.
    single = signals.tau_c(config(tau_c="calibrated", variant="no-rollout", **halves), 9.0)
    assert float((cost > single).float().mean()) == pytest.approx(float((10 * cost > 2.5).float().mean()), abs=0.01)

    gains = torch.tensor([1.0, 2.0, 3.0, -INF, 100.0, 100.0])  # nothing was feasible in the fourth; in the last two the safety gate speaks
    found = signals.thresholds(0.45, gains, made)
    assert (found["tau_c"], found["tau_r"], found["gain_median"]) == (0.45, 2.0, 2.0)
    assert found["g_cost_free_median"] == pytest.approx(0.25)
    assert found["safety_rate"] == pytest.approx(2 / 6)
    assert signals.thresholds(0.45, gains, config(tau_r_quantile=0.5, tau_r_floor=2.5))["tau_r"] == 2.5


@pytest.mark.parametrize(
    ("changes", "stands"),
    [
        ({}, [True, False, False, False]),
        ({"variant": "safety-only"}, [True, False, True, False]),  # a gain is none of its business
        ({"recheck": False}, [False, False, False, False]),
        ({"finalists": 0}, [False, False, False, False]),  # there are no fresh rollouts
    ],
)
def test_a_command_that_is_safe_after_all_stands_unless_the_plan_gains_more_than_tau_r(changes: dict[str, Any], stands: list[bool]) -> None:
    # A false alarm; a true one; a false one whose plan gains 3; a task correction.
    alone, predicted = returns([0.0] * 4, [0.4, 0.9, 0.4, 0.4]), returns([0.5, 0.5, 3.0, 0.5], [0.1] * 4)
    nothing = torch.zeros(4, 2)
    made = Plan(torch.ones(4, L, 1), torch.ones(4, dtype=torch.bool), nothing, nothing > 0, predicted, alone)
    found = assistant(**changes)._rechecked(made, torch.tensor([True, True, True, False]))
    assert (found.residuals == 0).flatten(1).all(1).tolist() == stands
    assert found.predicted.cost.tolist() == [float((alone if kept else predicted).cost[i]) for i, kept in enumerate(stands)]


def test_a_plan_is_remembered_as_long_as_it_should_be_and_never_in_another_episode() -> None:
    wasp = assistant(case2_memory=2)
    rows, plan = torch.arange(2), torch.tensor([1.0, 2.0, 3.0, 4.0]).view(1, L, 1).expand(2, L, 1)

    def remembered() -> tuple[list[list[float]], list[list[float]]]:
        kept = wasp._kept(rows)
        assert kept is not None
        return kept[..., 0].tolist(), wasp._start_distribution(rows)[0][..., 0].tolist()

    # The first decision carries out a safe plan, the second one of Case II.
    wasp._remember(plan, torch.tensor([True, True]), torch.tensor([False, True]))
    assert remembered() == ([[0, 0, 0, 0], [2, 3, 4, 0]], [[2, 3, 4, 0], [2, 3, 4, 0]])
    # Then the commands stand: nothing to begin with, but the escape stays a candidate, for two decisions in all.
    wasp._remember(torch.zeros_like(plan), torch.tensor([False, False]), torch.tensor([False, False]))
    assert remembered() == ([[0, 0, 0, 0], [3, 4, 0, 0]], [[0, 0, 0, 0], [0, 0, 0, 0]])
    wasp._remember(torch.zeros_like(plan), torch.tensor([False, False]), torch.tensor([False, False]))
    assert remembered()[0] == [[0, 0, 0, 0], [0, 0, 0, 0]]
    # What was no plan is no beginning, whatever is left of it.
    wasp._remember(plan, torch.tensor([False, True]), torch.tensor([True, True]))
    assert remembered() == ([[2, 3, 4, 0], [2, 3, 4, 0]], [[0, 0, 0, 0], [2, 3, 4, 0]])
    wasp.reset(torch.tensor([False, True]), [1, 3])
    assert remembered() == ([[2, 3, 4, 0], [0, 0, 0, 0]], [[0, 0, 0, 0], [0, 0, 0, 0]])
