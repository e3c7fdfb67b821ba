"""The search against a literal reading of Eq. 14-17: elites, both cases, the second look, and
what is selected.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
import scene_drives
import scene_worlds
import scenes
import torch
from scene_drives import Drive
from scene_worlds import Corridor, Fork
from torch import Tensor

from wasp_cli.methods.configs import WASPConfig
from wasp_cli.methods.wasp.imagine import Scored
from wasp_cli.methods.wasp.outcome import STD_FLOOR, Plan
from wasp_cli.methods.wasp.search import FINALISTS, SURVIVORS, search
from wasp_cli.metrics.episode import CUT_OFF, GATE_NONE, GATE_SAFETY, GATE_TASK

TAU_C, TAU_R = 0.3, 0.1
N, L = 40, 2


def config(**changes: Any) -> WASPConfig:
    sizes = {
        "horizon": 4,
        "residual_steps": L,
        "candidates": N,
        "elites": 10,
        "feasible": 5,
        "iterations": 3,
        "alpha": 0.1,
    }
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


def searched(
    settings: WASPConfig,
    normals: Tensor,
    score: Any = brake,
    again: Any = None,
    time_is_up: Any = None,
) -> Plan:
    known = torch.tensor([[[0.5], [0.0]], [[-0.1], [0.2]]]).expand(len(normals), -1, -1, -1)
    alone = score(torch.zeros(len(normals), 1, L, 1))
    return search(
        score,
        again or score,
        known,
        normals,
        alone,
        settings,
        TAU_C,
        TAU_R,
        time_is_up or (lambda: False),
    )


def s_task(found: Scored, n: int, alpha: float) -> float:
    return float(found.reward[0, n]) - alpha * float(found.residuals[0, n].square().sum())


def s_safe(found: Scored, n: int, alpha: float) -> float:
    return max(0.0, float(found.cost[0, n]) - TAU_C) + alpha * float(
        found.residuals[0, n].square().sum()
    )


def literal(
    settings: WASPConfig, normals: Tensor, score: Any, again: Any
) -> tuple[list[float], list[int]]:
    """The sequence that is selected for one decision, and |F_s| of every iteration."""
    alpha, only_case1 = settings.alpha, settings.variant == "no-case2"
    mean, std = torch.tensor([[-0.1], [0.2]]), torch.full((L, 1), settings.initial_std)
    counts, everything, kept = [], [], []
    for i in range(settings.iterations):
        candidates = list((mean + std * normals[0, i]).clamp(-2, 2))
        certain = (
            [torch.zeros(L, 1), torch.tensor([[0.5], [0.0]]), mean]
            if i == 0
            else [torch.zeros(L, 1), mean]
        )
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
        kept = [plans[n] for n in ranked[:SURVIVORS]]
        if elites:
            chosen = torch.stack([plans[n] for n in elites])
            mean = chosen.mean(0)
            std = (chosen - mean).square().mean(0).sqrt().clamp(min=STD_FLOOR)
    found = score(torch.stack(everything).unsqueeze(0))
    order = range(len(everything))
    best_task = sorted(
        order,
        key=lambda n: (
            (0, -s_task(found, n, alpha))
            if found.cost[0, n] <= TAU_C
            else (1, s_safe(found, n, alpha))
        ),
    )[:FINALISTS]
    best_safe = sorted(order, key=lambda n: s_safe(found, n, alpha))[:FINALISTS]
    finalists = [
        torch.zeros(L, 1),
        *(everything[n] for n in best_task),
        *(everything[n] for n in best_safe),
    ]
    second = again(torch.stack(finalists).unsqueeze(0))
    safe = [n for n in range(len(finalists)) if second.cost[0, n] <= TAU_C]
    if safe:
        best = max(safe, key=lambda n: s_task(second, n, alpha))
    else:
        best = (
            0 if only_case1 else min(range(len(finalists)), key=lambda n: s_safe(second, n, alpha))
        )
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
    assert (float(found.cost), float(found.reward)) == pytest.approx(
        (float(own.cost), float(own.reward))
    )
    alone = again(torch.zeros(1, 1, L, 1))
    assert (float(found.alone_cost), float(found.alone_reward)) == (
        float(alone.cost),
        float(alone.reward),
    )


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


# Worlds with a known answer: the paper's Fig. 1 in closed loop under the printed WASP, and what is
# imagined on the way.


SMALL = {"probe": 64, "candidates": 64, "elites": 16, "feasible": 16, "iterations": 3}
Kind = type[Corridor] | type[Fork]

ROWS = 8


@cache
def careful(kind: Kind, variant: str | None, steps: int = 80) -> Drive:
    """Eight careful drivers who are late, each in gusts of its own; without a variant alone."""
    world = kind(jitter=0.01)
    config = None if variant is None else scene_drives.settings(variant, **SMALL)
    return scene_drives.drive(
        world, scene_worlds.driver(world, scene_worlds.careful(world), batch=ROWS), config, steps
    )


@pytest.mark.parametrize("kind", [Corridor, Fork])
def test_the_prompt_driver_stops_in_time_and_the_late_one_does_not(kind):
    world = kind(jitter=0.01)
    prompt = scene_drives.drive(
        world, scene_worlds.driver(world, scene_worlds.careful(world), 0.0, ROWS), None, 80
    )
    assert (prompt.costs == 0).all()
    assert prompt.alive.all()  # he stands in front of the hazard
    assert (careful(kind, None).costs >= 8).all()


@pytest.mark.parametrize("kind", [Corridor, Fork])
def test_imagined_rollouts_are_in_time_and_one_step_is_too_late(kind):
    """Fig. 1(a, b)."""
    alone, full, near = careful(kind, None), careful(kind, "full"), careful(kind, "no-rollout")
    assert (full.costs == 0).all()
    assert (near.costs >= 0.8 * alone.costs).all()
    world = kind()
    for drive, low, high in ((full, 0.9, 1.5), (near, 0.0, 0.15)):
        first = (drive.gate == GATE_SAFETY).argmax(0)
        place = torch.from_numpy(drive.state[first, range(ROWS), : world.action_size])
        gap = -world.depth(place)
        assert (gap > low).all()
        assert (gap < high).all()


@pytest.mark.parametrize(("variant", "stops"), [("no-rollout", False), ("full", True)])
def test_when_one_step_shows_the_hazard_no_command_stops_in_time(variant, stops):
    """Full braking from the step at which the safety gate fired first."""
    world, drive = Corridor(), careful(Corridor, variant)
    first = (drive.gate == GATE_SAFETY).argmax(0)
    latent = world.at(*drive.state[first, range(ROWS)].tolist())
    inside = []
    for _ in range(10):
        latent = world.imagine(latent, torch.full((ROWS, 1), -1.0), torch.full((ROWS, 1), 0.5772))
        inside.append(world.inside(latent))
    assert (torch.stack(inside).amax(0) == (0.0 if stops else 1.0)).all()


def test_the_safety_gate_alone_brakes_and_stays_and_both_gates_steer_around():
    """Fig. 1(c, d)."""
    alone, safety, full = careful(Fork, None), careful(Fork, "safety-only"), careful(Fork, "full")
    assert (safety.costs == 0).all()
    assert (full.costs == 0).all()
    assert full.arrived.all()
    assert full.returns.mean() > 1.8 * safety.returns.mean()
    assert full.returns.mean() > 0.95 * alone.returns.mean()
    stuck = safety.state[-1, :, 0] < 1.8
    assert stuck.sum() >= ROWS - 1  # a gust may carry one around
    assert (np.abs(safety.state[-10:, stuck, 2:]) < 0.35).all()
    # The task gate took part, and the way led over the hazard's upper edge.
    assert ((full.gate == GATE_TASK) & full.alive).any(0).all()
    assert (full.state[..., 1].max(0) > 0.3).all()


@cache
def from_within(kind: Kind, variant: str | None) -> Drive:
    """Careful drivers who are late and begin in the hazard."""
    within = {
        Corridor: ((2.1, 0.0), (2.3, 0.0), (2.05, 0.5), (2.1, -0.2)),
        Fork: (
            (1.8, -0.05, 0.0, 0.0),
            (1.9, 0.1, 0.0, 0.0),
            (1.7, -0.2, 0.0, 0.0),
            (1.6, 0.0, 0.5, 0.0),
        ),
    }[kind]
    world = kind(jitter=0.01)
    config = None if variant is None else scene_drives.settings(variant, **SMALL)
    operator = scene_worlds.driver(world, scene_worlds.careful(world), batch=len(within))
    return scene_drives.drive(world, operator, config, 30, start=world.at(*within))


@pytest.mark.parametrize("kind", [pytest.param(Corridor, marks=pytest.mark.slow), Fork])
def test_case_two_leaves_the_hazard_sooner(kind):
    alone, full, without = (from_within(kind, variant) for variant in (None, "full", "no-case2"))
    assert (full.case2[0] == 1).all()  # nothing is safe at first
    assert (full.costs < alone.costs).all()
    assert (full.costs < without.costs).all()
    assert full.costs.mean() < 0.75 * without.costs.mean()


@pytest.mark.slow
def test_the_picture_shows_what_the_figure_claims(tmp_path):
    found = scenes.scenes(**SMALL)
    late, early, stuck, free = found
    assert late.assisted.costs[0] > 0
    assert [int(scene.assisted.costs[0]) for scene in (early, stuck, free)] == [0, 0, 0]
    assert free.assisted.arrived[0]
    assert not stuck.assisted.arrived[0]
    for scene in found:
        size = 2 * scene.world.action_size
        horizon = 1 if scene is late else 15
        assert scene.nominal.shape == scene.corrected.shape == (horizon + 1, scenes.ROLLOUTS, size)
        assert (scene.nominal[0] == scene.assisted.state[scene.moment, 0]).all()
        assert scene.assisted.gate[scene.moment, 0] == (GATE_TASK if scene is free else GATE_SAFETY)
        assert scene.alone.costs[0] > 0
        assert (scene.alone.gate == GATE_NONE).all()
    # What was imagined at the first alarm really leads into the hazard.
    world = early.world
    assert (
        float((world.depth(torch.from_numpy(early.nominal[..., :1])) > 0).any(0).float().mean())
        > 0.5
    )
    path = tmp_path / "scenes.png"
    scenes.draw(path, found)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size < 300_000
