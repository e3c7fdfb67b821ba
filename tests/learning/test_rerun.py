"""Stored episodes come back bit for bit, and what differs is noticed."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.cells import REPEAT, Evaluated, evaluated
from wasp_cli.errors import ArtifactError
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.models.world_model import load_world_model
from wasp_cli.seeds import layout_seed, method_seed
from wasp_cli.store.recorded import read_recorded


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "saferl", {})


def again(cell: Evaluated, **changes: Any) -> Rerun:
    world = cell.world()
    recorded = Recorded(**read_recorded(cell.path))._replace(**changes)
    return Rerun(world, load_world_model(cell.inputs["world_model"]), cell.operator(world), recorded)


@pytest.mark.parametrize(("variant", "value"), [("noisy", 0.4), ("reaction-time", 0.8)])
def test_latents_commands_and_actions_of_an_assisted_cell_come_back(inputs, parts, tmp_path, variant, value):
    cell = evaluated(inputs, tmp_path, "saferl", {}, variant, value)
    world = cell.world()
    layouts = [layout_seed(cell.task, cell.seed, e) for e in range(cell.episodes)]
    own = [method_seed(cell.task, variant, cell.seed, e, "saferl") for e in range(cell.episodes)]
    assistant = build_assistant("saferl", {}, parts)
    loop = run_episodes(world, parts.world_model, cell.operator(world), assistant, layouts, own, keep_latents=True)
    decisions = 0
    for moment in again(cell):
        alive = moment.alive
        assert alive.tolist() == loop.alive[moment.t].tolist()
        assert moment.t == decisions
        decisions += 1
        for found, expected in (
            (moment.latent.h, loop.h[moment.t]), (moment.latent.z, loop.z[moment.t]), (moment.a_h, torch.from_numpy(loop.a_h[moment.t])),
            (moment.action, torch.from_numpy(loop.action[moment.t])),
        ):  # fmt: skip
            assert torch.equal(found[alive], expected[alive])
    assert decisions == len(loop.reward) == 500 // REPEAT


def test_a_changed_action_is_noticed(cell):
    recorded = Recorded(**read_recorded(cell.path))
    changed = [actions.copy() for actions in recorded.a]
    changed[1][5] = -changed[1][5]
    with pytest.raises(ArtifactError, match=r"episode 1 is not the recorded one from decision [56] on"):
        list(again(cell, a=changed))


def test_a_changed_command_is_noticed_at_once_and_counted_within_its_cell(cell):
    changed = [commands.copy() for commands in Recorded(**read_recorded(cell.path)).a_h]
    changed[2][4, 0] = np.nextafter(changed[2][4, 0], np.float32(2.0))
    with pytest.raises(ArtifactError, match="episode 12 is not the recorded one from decision 4 on: the command of the operator"):
        list(again(cell, a_h=changed, first=10))
