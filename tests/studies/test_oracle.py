"""The true task as a world model: what is imagined is what then happens, and imagining moves nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from wasp_cli.errors import TaskError
from wasp_cli.methods.wasp.imagine import Draws, Imagination, Situation, corrected
from wasp_cli.methods.wasp.returns import discounted_sum
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import PrivilegedPolicy
from wasp_cli.operators.base import DrawnNoise, EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.studies.oracle import NoCritics, SimulatorModel, on_features
from wasp_cli.tasks.base import VectorTask
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

BATCH, HORIZON, RESIDUALS = 3, 15, 5
SEEDS = [31, 32, 33]
NOTHING = torch.zeros(0)


class World(NamedTuple):
    task: VectorTask
    model: SimulatorModel
    operator: Operator
    noise: EpisodeNoise
    """another one with the operator's own draws"""

    def see(self) -> Latent:
        """The latent of the task as it is now."""
        return self.model.filter(self.model.initial(self.task.batch), NOTHING, NOTHING, NOTHING)

    def command(self, latent: Latent) -> Tensor:
        return self.operator.command(latent.features).clamp(-1, 1)

    def draws_to_come(self) -> Tensor:
        """[H, B, K] what the operator will draw after the command that it has just issued."""
        self.noise.seek(self.operator.noise.position())
        return torch.stack([self.noise.next(self.operator.draws) for _ in range(HORIZON)])


def world(name: str, variant: str = "laggy", value: float = 0.7, batch: int = BATCH) -> World:
    def build(rows: int) -> VectorTask:
        return make_task(name, rows, observe=("privileged",))

    task = build(batch)
    task.reset(SEEDS[:batch])
    torch.manual_seed(1)
    policy = PrivilegedPolicy(task.privileged_size, [16], task.action_size).requires_grad_(False)
    for weights in policy.net.parameters():
        weights.mul_(3.0)  # else it hardly moves
    context = OperatorContext(lambda fraction: on_features(policy), task.action_size, task.decision_seconds)
    operator = build_operator(variant, value, context, EpisodeNoise(SEEDS[:batch]), batch)
    return World(task, SimulatorModel(task, build), operator, EpisodeNoise(SEEDS[:batch]))


def drive(of: World, decisions: int, interventions: int = 0) -> None:
    """The closed loop, with random corrections in the last decisions."""
    rng = np.random.default_rng(0)
    for t in range(decisions):
        action = of.command(of.see())
        if t >= decisions - interventions:
            action = (action + torch.from_numpy(rng.normal(size=action.shape).astype(np.float32))).clamp(-1, 1)
        of.operator.observe(action)
        of.task.step(action.numpy())


CASES = [("goal1", "laggy", 0.7, 6), ("goal1", "noisy", 0.4, 6), ("race1", "laggy", 0.7, 25), ("race1", "noisy", 0.4, 28),
         ("race1", "reactive", 0.5, 28)]  # fmt: skip


@pytest.mark.parametrize(("name", "variant", "value", "decisions"), CASES)
def test_what_is_imagined_under_the_true_operator_then_happens_bit_for_bit(name: str, variant: str, value: float, decisions: int) -> None:
    of = world(name, variant, value)
    drive(of, decisions, interventions=4)
    residuals = torch.randn(RESIDUALS, BATCH, 2, generator=torch.Generator().manual_seed(2))
    latent = of.see()
    now = of.command(latent)
    imagined, mind = [latent], of.operator.fork(torch.arange(BATCH), 1, DrawnNoise(of.draws_to_come()))
    for k in range(HORIZON):
        command = now if k == 0 else mind.command(imagined[-1].features)
        action = (command + residuals[k]).clamp(-1, 1) if k < RESIDUALS else command
        mind.observe(action)
        imagined.append(of.model.imagine(imagined[-1], action, NOTHING))
    costs = 0
    for k in range(HORIZON):
        command = now if k == 0 else of.command(of.see())
        action = (command + residuals[k]).clamp(-1, 1) if k < RESIDUALS else command
        of.operator.observe(action)
        step = of.task.step(action.numpy())
        there = imagined[k + 1]
        assert step.observation.privileged is not None
        assert torch.equal(on_features(lambda seen: seen)(there.features), torch.from_numpy(step.observation.privileged)), k
        assert torch.equal(of.model.reward(there), torch.from_numpy(step.reward.astype(np.float32))), k
        assert torch.equal(of.model.cost(there), torch.from_numpy(step.cost.astype(np.float32))), k
        assert torch.equal(of.model.continues(there), torch.from_numpy(1 - step.ended.astype(np.float32))), k
        costs += int(step.cost.sum())
    assert 0 < costs < BATCH * HORIZON


@pytest.mark.parametrize(("variant", "value"), [("noisy", 0.4), ("reactive", 0.5)])
def test_returns_of_the_planner_are_those_of_the_task(variant: str, value: float) -> None:
    of = world("goal1", variant, value)
    drive(of, 30)
    residuals = 0.5 * torch.randn(BATCH, 1, RESIDUALS, 2, generator=torch.Generator().manual_seed(2))
    latent = of.see()
    now = of.command(latent)
    draws = Draws(torch.zeros(BATCH, HORIZON, 1, 0), of.draws_to_come().transpose(0, 1).unsqueeze(2))
    imagination = Imagination(of.model, NoCritics(), of.operator.policy, 0.99, 0.95, 1.0)
    imagined = imagination.roll(Situation(latent, now, of.operator, torch.arange(BATCH)), 1, corrected(residuals, draws), draws)
    found_reward, found_cost = discounted_sum(imagined.reward(), 0.99), discounted_sum(imagined.cost(), 0.95)
    reward, cost = np.zeros(BATCH), np.zeros(BATCH)
    for k in range(HORIZON):
        command = now if k == 0 else of.command(of.see())
        action = (command + residuals[:, 0, k]).clamp(-1, 1) if k < RESIDUALS else command
        of.operator.observe(action)
        step = of.task.step(action.numpy())
        reward += 0.99**k * step.reward
        cost += 0.95**k * step.cost
    assert found_reward[:, 0, 0].numpy() == pytest.approx(reward, abs=1e-5)
    assert found_cost[:, 0, 0].numpy() == pytest.approx(cost, abs=1e-5)


@pytest.mark.parametrize("name", ["goal1", "race1"])
def test_imagining_leaves_the_task_as_it_is(name: str) -> None:
    of = world(name)
    drive(of, 10)
    latent = of.see()
    before = of.task.snapshot()
    for copies in (1, 4):
        imagined = latent.expand_rows(copies)
        for _ in range(8):
            imagined = of.model.imagine(imagined, torch.ones(BATCH * copies, 2), NOTHING)
    after = of.task.snapshot()
    assert all(before[field].tobytes() == after[field].tobytes() for field in before)
    assert torch.equal(of.see().features[:, 3:], latent.features[:, 3:])


def test_rows_know_nothing_of_their_neighbours() -> None:
    of = world("race1")
    drive(of, 15)
    latent = of.see()
    actions = torch.rand(6, BATCH * 4, 2, generator=torch.Generator().manual_seed(3)) * 2 - 1

    def rollout(rows: Tensor) -> Tensor:
        """What is imagined of some of the copies."""
        imagined = latent.expand_rows(4).rows(rows)
        for action in actions:
            imagined = of.model.imagine(imagined, action[rows], NOTHING)
        return imagined.features[:, 3:]

    together = rollout(torch.arange(BATCH * 4))
    for rows in ([0], [7, 2], [11, 3, 5, 4]):
        assert torch.equal(rollout(torch.tensor(rows)), together[rows])
    assert not torch.equal(together[0], together[1])


def test_after_the_end_of_an_episode_nothing_comes() -> None:
    of = world("goal1", batch=2)
    for t in range(of.task.max_decisions - 3):
        if t == 20:
            of.task.reset(SEEDS[:1], np.array([True, False]))  # the first episode lasts longer
        of.task.step(np.array([[0.3, 0.1], [0.3, 0.1]]))
    imagined = of.see()
    goes_on, pays = [], []
    for _ in range(6):
        imagined = of.model.imagine(imagined, torch.full((2, 2), 0.3), NOTHING)
        goes_on.append(of.model.continues(imagined).tolist())
        pays.append(of.model.reward(imagined).tolist())
    assert goes_on == [[1, 1], [1, 1], [1, 0], [1, 0], [1, 0], [1, 0]]
    assert all(reward[0] != 0 for reward in pays)
    assert [reward[1] != 0 for reward in pays] == [True] * 3 + [False] * 3

    for _ in range(3):
        of.task.step(np.full((2, 2), 0.3))
    latent = of.see()
    assert of.model.continues(latent).tolist() == [1, 0]
    over = latent.rows(torch.tensor([1, 1]))  # only what has ended: a task would refuse to be stepped
    for _ in range(2):
        over = of.model.imagine(over, torch.ones(2, 2), NOTHING)
    assert torch.equal(over.features[:, 6:], latent.features[[1, 1], 6:])
    assert (of.model.reward(over).tolist(), of.model.cost(over).tolist(), of.model.continues(over).tolist()) == ([0, 0], [0, 0], [0, 0])


def test_a_state_that_the_simulator_has_left_is_refused() -> None:
    of = world("goal0")
    action = torch.zeros(BATCH, 2)
    old = of.see()
    first = of.model.imagine(old, action, NOTHING)
    second = of.model.imagine(first, action, NOTHING)
    unknown = of.model.initial(BATCH)
    for latent in (first, second.rows(torch.tensor([1, 0, 2])), second.rows(torch.tensor([0, 1])), unknown):
        with pytest.raises(TaskError, match="has left"):
            of.model.imagine(latent, action[: len(latent.h)], NOTHING)
    assert torch.equal(of.model.imagine(old, action, NOTHING).features[:, 1:], first.features[:, 1:])  # again from the beginning
    with pytest.raises(TaskError, match="has left"):
        of.model.imagine(second, action, NOTHING)
    of.see()
    with pytest.raises(TaskError, match="has left"):
        of.model.imagine(old, action, NOTHING)


def test_snapshots_without_rows_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    of = world("goal0")
    monkeypatch.setattr(of.task, "snapshot", lambda: {"clock": np.zeros(1)})
    with pytest.raises(TaskError, match="no rows in 'clock'"):
        of.see()


@pytest.mark.parametrize("name", TASKS)
def test_every_snapshot_has_rows_and_says_who_has_ended(name: str) -> None:
    task = make_task(name, BATCH, observe=())
    task.reset(SEEDS)
    snapshot = task.snapshot()
    assert {len(array) for array in snapshot.values()} == {BATCH}
    assert snapshot["ended"].tolist() == [False] * BATCH
