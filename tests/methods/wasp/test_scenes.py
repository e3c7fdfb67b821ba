"""Worlds with a known answer: the paper's Fig. 1 in closed loop under the printed WASP, and what is imagined on the way.

Dimension letters: H horizon, A action size, B episodes.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
import scene_drives
import scene_worlds
import scenes
import torch
from scene_drives import Drive
from scene_worlds import Corridor, Fork, PointWorld
from torch import Tensor

from wasp_cli.methods.wasp.imagine import Draws, Situation
from wasp_cli.methods.wasp.printed import Printed
from wasp_cli.metrics.episode import GATE_NONE, GATE_SAFETY, GATE_TASK
from wasp_cli.models.base import Latent
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext
from wasp_cli.operators.laggy import LaggyOperator

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


def test_the_task_gate_alone_drives_through():
    assert careful(Fork, "task-only").costs.mean() > careful(Fork, "full").costs.mean() + 8


def test_an_expert_who_avoids_the_hazard_is_left_alone():
    world = Fork(jitter=0.01)
    around = scene_worlds.driver(world, scene_worlds.around(world), 0.0, ROWS)
    drive = scene_drives.drive(world, around, scene_drives.settings(**SMALL), 60)
    assert (drive.costs == 0).all()
    assert drive.arrived.all()
    assert drive.int_rate <= 0.1  # the best of 64 random plans gains a little at times
    assert not ((drive.gate == GATE_SAFETY) & drive.alive).any()


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


def test_an_operator_who_repeats_himself_is_kept_out_of_the_hazard_too():
    """A laggy driver is random: what he will do is known only in distribution."""
    costs = {}
    for variant in (None, "full"):
        world = Corridor(jitter=0.01)
        context = OperatorContext(lambda _: scene_worlds.careful(world), 1, scene_worlds.STEP)  # noqa: B023
        operator = LaggyOperator.build(0.85, context, EpisodeNoise(range(ROWS)), ROWS)
        costs[variant] = scene_drives.drive(world, operator, None if variant is None else scene_drives.settings(**SMALL), 60).costs
    assert costs[None].mean() > 2
    assert costs["full"].mean() < 0.25 * costs[None].mean()


class Moment(NamedTuple):
    latent: Latent
    a_h: Tensor
    operator: Operator
    """with its memory of that moment"""


def moments(world: PointWorld, steps: int) -> tuple[list[Moment], Drive]:
    """Every decision of a late driver alone."""
    found: list[Moment] = []

    def watch(latent: Latent, a_h: Tensor, operator: Operator) -> None:
        found.append(Moment(latent, a_h, operator.fork(torch.zeros(1, dtype=torch.long), 1, operator.noise)))

    return found, scene_drives.drive(world, scene_worlds.driver(world, scene_worlds.careful(world)), None, steps, watch=watch)


@pytest.mark.parametrize("kind", [Corridor, Fork])
def test_a_late_driver_is_foreseen_only_with_his_memory(kind):
    """Without gusts, the late driver with his queue is foreseen exactly, and a prompt one in his place is not.

    The safety gate would fire at every one of the 13 decisions before he enters the hazard; for a prompt driver at the last 4 only, when
    seven steps of braking are needed; and for one without his queue not at the first three.
    """
    world, config = kind(), scene_drives.settings()
    found, truth = moments(world, 70)
    entry = int(truth.cost[:, 0].argmax())
    drivers = {
        "own": None,
        "forgotten": scene_worlds.driver(world, scene_worlds.careful(world)),
        "prompt": scene_worlds.driver(world, scene_worlds.careful(world), 0.0),
    }
    errors, alarms = {}, {}
    for name, other in drivers.items():
        wrong, fired = [], []
        for t in range(entry - 13, entry):
            latent, a_h, own = found[t]
            operator = own if other is None else other
            states = scene_drives.imagined(world, operator, latent, a_h, config.horizon, 1)[:, 0]
            wrong.append(float(np.abs(states - truth.state[t : t + config.horizon + 1, 0]).max()))
            start = Situation(latent, a_h, operator, torch.zeros(1, dtype=torch.long))
            draws = Draws(torch.zeros(1, config.horizon, 1, world.noise_size), torch.zeros(1, config.horizon, 1, 0))
            printed = Printed(config, scene_drives.imagination(world), {})
            fired.append(float(printed.nominal(start, draws).cost) > scene_drives.TAU_C)
        errors[name], alarms[name] = max(wrong), fired
    assert errors["own"] < 1e-4
    assert errors["prompt"] > 0.2
    assert errors["forgotten"] > 0.2
    assert all(alarms["own"])
    assert not any(alarms["prompt"][:-4])
    assert not any(alarms["forgotten"][:3])


def test_the_drawn_rollouts_are_those_that_the_gate_sums():
    world, config = Corridor(), scene_drives.settings(**SMALL)
    seen: list[float] = []

    def watch(latent: Latent, a_h: Tensor, operator: Operator) -> None:
        states = torch.from_numpy(scene_drives.imagined(world, operator, latent, a_h, config.horizon, 1))
        cost = world.cost(Latent(states[1:, 0], states[1:, 0, :1]))
        seen.append(float((scene_drives.GAMMA_C ** torch.arange(config.horizon) * cost).sum()))

    drive = scene_drives.drive(world, scene_worlds.driver(world, scene_worlds.careful(world)), config, 30, watch=watch)
    np.testing.assert_allclose(drive.g_cost[:, 0], seen, atol=1e-4)
    assert drive.g_cost.max() > 1


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
