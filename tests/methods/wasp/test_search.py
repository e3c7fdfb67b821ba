"""The search against a literal reading of Eq. 14-17: elites, both cases, the second look, and what is selected."""

from typing import Any

import pytest
import torch
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.methods.wasp.outcome import STD_FLOOR, Plan
from wasp_cli.methods.wasp.search import FINALISTS, KEPT, search
from wasp_cli.metrics.episode import CUT_OFF

TAU_C, TAU_R = 0.3, 0.1
N, L = 40, 2


def config(**changes: Any) -> WASPConfig:
    sizes = {"horizon": 4, "residual_steps": L, "candidates": N, "elites": 10, "feasible": 5, "iterations": 3, "alpha": 0.1}
    return WASPConfig.model_validate(sizes | changes)


def brake(residuals: Tensor) -> Scored:
    """Whoever brakes by .4 at first is safe, and loses what he brakes."""
    first = residuals[:, :, 0, 0]
    return Scored(residuals, 2.0 * first + residuals[:, :, 1, 0], (first >= -0.4).float())


def hopeless(residuals: Tensor) -> Scored:
    """The harder the brake the smaller the cost, which never becomes small enough."""
    return Scored(residuals, residuals[:, :, 0, 0], TAU_C + 2.5 + residuals[:, :, 0, 0])


def noisy(residuals: Tensor) -> Scored:
    """The second look: what looked safe may be unsafe."""
    found = brake(residuals)
    return found._replace(cost=(residuals[:, :, 0, 0] >= -0.7).float())


def searched(settings: WASPConfig, normals: Tensor, score: Any = brake, again: Any = None, time_is_up: Any = None) -> Plan:
    known = torch.tensor([[[0.5], [0.0]], [[-0.1], [0.2]]]).expand(len(normals), -1, -1, -1)
    alone = score(torch.zeros(len(normals), 1, L, 1))
    return search(score, again or score, known, normals, alone, settings, TAU_C, TAU_R, time_is_up or (lambda: False))


def s_task(found: Scored, n: int, alpha: float) -> float:
    return float(found.reward[0, n]) - alpha * float(found.residuals[0, n].square().sum())


def s_safe(found: Scored, n: int, alpha: float) -> float:
    return max(0.0, float(found.cost[0, n]) - TAU_C) + alpha * float(found.residuals[0, n].square().sum())


def literal(settings: WASPConfig, normals: Tensor, score: Any, again: Any) -> tuple[list[float], list[int]]:
    """The sequence that is selected for one decision, and |F_s| of every iteration."""
    alpha, only_case1 = settings.alpha, settings.variant == "no-case2"
    mean, std = torch.tensor([[-0.1], [0.2]]), torch.full((L, 1), settings.initial_std)
    counts, everything, kept = [], [], []
    for i in range(settings.iterations):
        candidates = list((mean + std * normals[0, i]).clamp(-2, 2))
        certain = [torch.zeros(L, 1), torch.tensor([[0.5], [0.0]]), mean] if i == 0 else [torch.zeros(L, 1), mean]
        candidates[: len(certain)] = certain
        everything += candidates
        found = score(torch.stack([*candidates, *kept]).unsqueeze(0))
        plans = found.residuals[0]
        safe = [n for n in range(len(plans)) if found.cost[0, n] <= TAU_C]
        counts.append(len(safe))
        by_task = sorted(safe, key=lambda n: -s_task(found, n, alpha))
        if len(safe) >= settings.feasible or only_case1:
            elites, ranked = by_task[: settings.elites], by_task
        else:
            ranked = sorted(range(len(plans)), key=lambda n: s_safe(found, n, alpha))
            elites = ranked[: settings.feasible]
        kept = [plans[n] for n in ranked[:KEPT]]
        if elites:
            chosen = torch.stack([plans[n] for n in elites])
            mean = chosen.mean(0)
            std = (chosen - mean).square().mean(0).sqrt().clamp(min=STD_FLOOR)
    found = score(torch.stack(everything).unsqueeze(0))
    order = range(len(everything))
    best_task = sorted(order, key=lambda n: (0, -s_task(found, n, alpha)) if found.cost[0, n] <= TAU_C else (1, s_safe(found, n, alpha)))[
        :FINALISTS
    ]
    best_safe = sorted(order, key=lambda n: s_safe(found, n, alpha))[:FINALISTS]
    finalists = [torch.zeros(L, 1), *(everything[n] for n in best_task), *(everything[n] for n in best_safe)]
    second = again(torch.stack(finalists).unsqueeze(0))
    safe = [n for n in range(len(finalists)) if second.cost[0, n] <= TAU_C]
    if safe:
        best = max(safe, key=lambda n: s_task(second, n, alpha))
    else:
        best = 0 if only_case1 else min(range(len(finalists)), key=lambda n: s_safe(second, n, alpha))
    if 0 in safe and float(second.reward[0, best] - second.reward[0, 0]) <= TAU_R:
        best = 0
    return finalists[best].flatten().tolist(), counts


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("feasible", [3, 30])
@pytest.mark.parametrize(("score", "again"), [(brake, brake), (brake, noisy), (hopeless, hopeless)])
@pytest.mark.parametrize("variant", ["full", "no-case2"])
def test_a_whole_search_equals_its_literal_reading(seed, feasible, score, again, variant):
    settings = config(feasible=feasible, variant=variant)
    normals = torch.randn(1, 3, N, L, 1, generator=torch.Generator().manual_seed(seed))
    if variant == "no-case2" and score is hopeless:
        settings = config(feasible=feasible, variant=variant, iterations=1)
        normals = normals[:, :1]
    found = searched(settings, normals, score, again)
    wanted, counts = literal(settings, normals, score, again)
    assert found.residuals.flatten().tolist() == pytest.approx(wanted, abs=1e-6)
    assert found.safe[0].tolist() == counts
    assert found.case2[0].tolist() == [count < feasible for count in counts]
    own = again(found.residuals.unsqueeze(1))
    assert (float(found.cost), float(found.reward)) == pytest.approx((float(own.cost), float(own.reward)))
    alone = again(torch.zeros(1, 1, L, 1))
    assert (float(found.alone_cost), float(found.alone_reward)) == (float(alone.cost), float(alone.reward))


def test_decisions_of_a_batch_do_not_touch_each_other():
    normals = torch.randn(3, 3, N, L, 1, generator=torch.Generator().manual_seed(0))
    together = searched(config(), normals).residuals
    for b in range(3):
        torch.testing.assert_close(searched(config(), normals[b : b + 1]).residuals[0], together[b])


@pytest.mark.parametrize(("looks", "made"), [(0, 1), (1, 2), (2, 3)])
def test_a_search_that_is_cut_off_returns_its_best_so_far(looks, made):
    asked = iter([False] * looks + [True] * 9)
    batches: list[int] = []

    def counted(residuals: Tensor) -> Scored:
        batches.append(residuals.shape[1])
        return brake(residuals)

    normals = torch.randn(1, 3, N, L, 1, generator=torch.Generator().manual_seed(2))
    found = searched(config(), normals, counted, time_is_up=lambda: next(asked))
    assert batches == [1] + [N] * made, "no finalists"
    assert (found.safe[0] == CUT_OFF).tolist() == [True] * (3 - made) + [False] * made
    assert float(found.cost) <= TAU_C < float(found.alone_cost)
    patient = searched(config(), normals, time_is_up=lambda: False)
    torch.testing.assert_close(patient.residuals, searched(config(), normals).residuals, rtol=0, atol=0)
