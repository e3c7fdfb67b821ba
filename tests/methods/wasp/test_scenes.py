"""Worlds with a known answer: the paper's Fig. 1 in closed loop under the printed WASP, and what is imagined on the way.

Dimension letters: H horizon, A action size, B episodes.
"""

from functools import cache

import numpy as np
import pytest
import scene_drives
import scene_worlds
import scenes
import torch
from scene_drives import Drive
from scene_worlds import Corridor, Fork

from wasp_cli.metrics.episode import GATE_NONE, GATE_SAFETY, GATE_TASK

SMALL = {"probe": 64, "candidates": 64, "elites": 16, "feasible": 16, "iterations": 3}
Kind = type[Corridor] | type[Fork]

ROWS = 8


@cache
def careful(kind: Kind, variant: str | None, steps: int = 80) -> Drive:
    """Eight careful drivers who are late, each in gusts of its own; without a variant alone."""
    world = kind(jitter=0.01)
    config = None if variant is None else scene_drives.settings(variant, **SMALL)
    return scene_drives.drive(world, scene_worlds.driver(world, scene_worlds.careful(world), batch=ROWS), config, steps)


@pytest.mark.parametrize("kind", [Corridor, Fork])
def test_the_prompt_driver_stops_in_time_and_the_late_one_does_not(kind):
    world = kind(jitter=0.01)
    prompt = scene_drives.drive(world, scene_worlds.driver(world, scene_worlds.careful(world), 0.0, ROWS), None, 80)
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
        Fork: ((1.8, -0.05, 0.0, 0.0), (1.9, 0.1, 0.0, 0.0), (1.7, -0.2, 0.0, 0.0), (1.6, 0.0, 0.5, 0.0)),
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
    assert float((world.depth(torch.from_numpy(early.nominal[..., :1])) > 0).any(0).float().mean()) > 0.5
    path = tmp_path / "scenes.png"
    scenes.draw(path, found)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size < 300_000
