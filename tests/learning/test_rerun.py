"""Stored episodes come back bit for bit, recorded actions are carried out again, and what differs is noticed."""

from typing import Any

import numpy as np
import pytest
import torch

from tests.cells import REPEAT, Evaluated, evaluated
from wasp_cli.errors import ArtifactError
from wasp_cli.learning.assistants import build_assistant
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.playback import play, side_by_side
from wasp_cli.learning.rerun import Recorded, Rerun
from wasp_cli.models.world_model import load_world_model
from wasp_cli.seeds import layout_seed, method_seed
from wasp_cli.store.recorded import read_recorded
from wasp_cli.tasks.base import Observation, Step


@pytest.fixture(scope="module")
def cell(inputs, tmp_path_factory) -> Evaluated:
    return evaluated(inputs, tmp_path_factory.mktemp("cell"), "saferl", {})


def again(cell: Evaluated, **changes: Any) -> Rerun:
    world = cell.world()
    recorded = Recorded(**read_recorded(cell.path))._replace(**changes)
    return Rerun(world, load_world_model(cell.inputs["world_model"]), cell.operator(world), recorded)


@pytest.mark.parametrize(("variant", "value"), [("reaction-time", 0.8)])
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


LENGTHS = (4, 2, 3)


class Counting:
    """Rows that end after LENGTHS decisions; a reward is the sum of the actions so far."""

    batch = len(LENGTHS)

    def reset(self, seeds: list[int]) -> Observation:
        self.seeds, self.t, self.sums = seeds, 0, np.zeros(self.batch)
        return Observation(None, None, None)

    def step(self, action: Any) -> Step:
        self.t += 1
        self.sums = self.sums + action.sum(1)
        ended, nothing = np.array([self.t >= length for length in LENGTHS]), np.zeros(self.batch, np.int64)
        return Step(Observation(None, None, None), self.sums, nothing > 0, nothing, {}, nothing, nothing, ended, ended)


@pytest.fixture
def recorded() -> tuple[list[Any], list[Any]]:
    random = np.random.default_rng(0)
    actions = [random.uniform(-1, 1, (length, 2)).astype(np.float32) for length in LENGTHS]
    return actions, [np.cumsum(episode.sum(1).astype(np.float64)).astype(np.float32) for episode in actions]


def played(actions: list[Any], rewards: list[Any], tolerance: float = 0.0) -> list[Any]:
    task: Any = Counting()
    return list(play(task, range(5, 5 + task.batch), actions, rewards, tolerance))


def test_there_is_a_moment_before_every_decision_and_one_after_the_last(recorded):
    moments = played(*recorded)
    assert [moment.t for moment in moments] == [0, 1, 2, 3, 4]
    assert [moment.alive.tolist() for moment in moments] == [[t < length for length in LENGTHS] for t in range(5)]
    np.testing.assert_array_equal([moment.action for moment in moments[:-1]], side_by_side(recorded[0]))
    assert not moments[-1].action.any()
    assert moments[0].last is None
    assert [moment.last.ended.sum() for moment in moments[1:]] == [0, 1, 2, 3]


def test_a_reward_may_differ_by_the_tolerance_and_no_more(recorded):
    actions, rewards = recorded
    rewards[2][1] += 3e-5
    assert len(played(actions, rewards, 1e-4)) == 5
    with pytest.raises(ArtifactError, match="episode 2 is not the recorded one from decision 1 on: the reward is") as caught:
        played(actions, rewards)
    assert "other libraries" in str(caught.value.hint)


@pytest.mark.parametrize(("by", "what", "at"), [(-1, "goes on", 0), (1, "ends", 1)])
def test_an_episode_of_another_length_is_refused(by, what, at, recorded):
    actions, rewards = recorded
    actions[1], rewards[1] = np.resize(actions[1], (2 + by, 2)), np.resize(rewards[1], 2 + by)
    with pytest.raises(ArtifactError, match=f"episode 1 is not the recorded one from decision {at} on: the episode {what} here"):
        played(actions, rewards)
