"""Vector environments and the closed loop over episodes that end at different times, with a world model and without one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from wasp_cli.errors import WaspError
from wasp_cli.learning.closed_loop import Loop, run_episodes
from wasp_cli.learning.configs import ResidualConfig
from wasp_cli.learning.dataset import record
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.learning.heldout import load_heldout, save_heldout
from wasp_cli.learning.nominal import heldout_rows
from wasp_cli.learning.residual import AssistedTask
from wasp_cli.learning.vec_env import TaskVecEnv
from wasp_cli.methods.base import Assistant, Decision
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.base import Latent
from wasp_cli.models.state import StateWorld
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.tasks.base import Bools, Observation, Step


class Staggered:
    """A task whose episode of seed s lasts 2 + s % 4 decisions; observations name (seed, step); the reward is the first action.

    Odd seeds terminate, even ones are cut off by the time limit.
    """

    action_size, privileged_size, state_size, action_repeat = 2, 3, 3, 4
    decision_seconds, max_decisions, cost_sources = 0.08, 6, ("hazards",)
    action_low, action_high = -np.ones(2), np.ones(2)

    def __init__(self, batch: int) -> None:
        self.batch = batch
        self.seed = np.zeros(batch, int)
        self.t = np.zeros(batch, int)
        self.over = np.ones(batch, bool)

    def see(self) -> Observation:
        pixels = np.stack(
            [np.random.default_rng([s, t]).integers(0, 256, (6, 64, 64), dtype=np.uint8) for s, t in zip(self.seed, self.t, strict=True)]
        )
        vector = np.stack([self.seed, self.t, self.over], 1)
        return Observation(pixels, vector.astype(float), vector.astype(np.float32))

    def reset(self, seeds: Sequence[int], rows: Any = None) -> Observation:
        rows = np.ones(self.batch, bool) if rows is None else rows
        self.seed[rows], self.t[rows], self.over[rows] = list(seeds), 0, False
        return self.see()

    def step(self, action: Any) -> Step:
        live = ~self.over
        self.t[live] += 1
        self.over = self.over | (self.t >= 2 + self.seed % 4)
        ones = live.astype(np.int64)
        cost = live & (self.t == 2)
        return Step(
            self.see(), np.where(live, action[:, 0], 0.0), cost, 3 * cost.astype(np.int64), {"hazards": cost.astype(np.int64)}, 0 * ones,
            4 * ones, self.over.copy(), self.over & (self.seed % 2 == 1),
        )  # fmt: skip


def counter(start: int = 0) -> Any:
    numbers = iter(range(start, 10_000))
    return lambda: next(numbers)


def test_episodes_restart_row_by_row_with_their_terminal_observation():
    env = TaskVecEnv(Staggered(3), 3, -1.0, 1.0, counter())
    env.multiplier = 0.5
    seen = env.reset()
    assert seen[:, 0].tolist() == [0, 1, 2]
    for t in range(1, 8):
        before = seen
        env.step_async(np.full((3, 2), 0.25, np.float32))
        seen, reward, done, infos = env.step_wait()
        for row in range(3):
            seed, step = before[row, :2]
            ended = step + 1 == 2 + seed % 4
            assert done[row] == ended, (t, row)
            assert reward[row] == pytest.approx(0.25 - 0.5 * (step + 1 == 2))
            if ended:
                assert infos[row]["terminal_observation"].tolist() == [seed, step + 1, 1]
                assert infos[row]["TimeLimit.truncated"] == (seed % 2 == 0)
                assert seen[row, 1] == 0  # the next episode has begun
                assert seen[row, 0] > seed
            else:
                assert infos[row] == {}
                assert seen[row].tolist() == [seed, step + 1, 0]


@pytest.mark.parametrize("operators", [{"laggy": (0.5,)}, {"reactive": (0.5,)}], ids=list)
def test_the_assisted_task_moves_every_row_as_if_it_were_alone(parts, operators):
    """Restarting some rows must leave the filter, the operators and their noise of the others where they were."""

    def drive(rows: Sequence[int], steps: int) -> np.ndarray:
        config = ResidualConfig(operators=operators)
        env = AssistedTask(Staggered(len(rows)), parts.world_model, parts.skills, config, "t", 0)
        lines = {row: iter(range(row, 1000, 4)) for row in rows}
        owner = iter(())

        def following() -> int:
            return next(lines[next(owner)])

        env._next_seed = env._noise_seed = following
        seen = []
        owner = iter([*rows, *rows])
        seen.append(env.reset())
        for _ in range(steps):
            env.step_async(np.full((len(rows), 2), 0.1, np.float32))
            t = env.task.t + 1
            ending = [row for row, s, step in zip(rows, env.task.seed, t, strict=True) if step >= 2 + s % 4]
            owner = iter([*ending, *ending])
            seen.append(env.step_wait()[0])
        return np.stack(seen)

    together = drive([0, 1, 2], 9)
    for row in (0, 1, 2):
        np.testing.assert_allclose(drive([row], 9)[:, 0], together[:, row], atol=1e-5)


class Changing(HumanOnly):
    """An assistant that makes the command its own."""

    def decide(self, latent: Latent, a_h: Tensor, operator: Operator) -> Decision:
        a_h *= 0.5
        return super().decide(latent, a_h, operator)


def test_the_closed_loop_refuses_a_command_that_was_changed_in_place(parts):
    operator = build_operator("noisy", 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([0]), 1)
    with pytest.raises(WaspError, match="'Changing' changed the operator's command in place"):
        run_episodes(Staggered(1), parts.world_model, operator, Changing(), [0], [0])


def test_the_closed_loop_cuts_every_episode_at_its_end(parts, tmp_path):
    seeds = [0, 1, 2, 3]
    task = Staggered(4)
    operator = build_operator("noisy", 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise(seeds), 4)
    loop = run_episodes(task, parts.world_model, operator, HumanOnly(), seeds, seeds, keep_latents=True)
    found, times = trajectories(loop)
    assert [t.steps for t in found] == [2, 3, 4, 5] == [len(t) for t in times]
    for trajectory in found:
        assert trajectory.env_steps.tolist() == [4] * trajectory.steps
        assert trajectory.cost.sum() == 1
        np.testing.assert_allclose(trajectory.reward, trajectory.a[:, 0])
    save_heldout(heldout_rows(loop), tmp_path)
    rows = load_heldout(tmp_path)
    assert rows.episode.tolist() == [0] * 2 + [1] * 3 + [2] * 4 + [3] * 5
    torch.testing.assert_close(rows.latent.h[2:5], loop.h[:3, 1])


def test_recorded_rows_arrive_with_what_led_to_them():
    actions: list[np.ndarray] = []

    def command(privileged: np.ndarray) -> np.ndarray:
        actions.append(np.random.default_rng(len(actions)).uniform(-1, 1, (3, 2)).astype(np.float32))
        return actions[-1]

    data = record(Staggered(3), [0, 1, 3], command, ["expert", "noisy", "noisy"], number=7)
    assert data.episode.tolist() == [7] * 3 + [8] * 4 + [9] * 6
    assert np.flatnonzero(data.first).tolist() == [0, 3, 7]
    assert data.privileged[:, 1].tolist() == [*range(3), *range(4), *range(6)]
    assert np.flatnonzero(data.terminal).tolist() == [6, 12]  # the first episode was cut off, the others ended by their rule
    np.testing.assert_array_equal(data.action[3:7], [[0, 0], *(a[1] for a in actions[:3])])
    np.testing.assert_allclose(data.reward[1:3], [a[0, 0] for a in actions[:2]], rtol=1e-6)
    assert np.flatnonzero(data.cost_env).tolist() == [2, 5, 9]


ROWS = 6
WORLD = StateWorld(1, 1)


class Line:
    """A place on a line, moved by a tenth of the command; the goal, at 1 or -1, is privileged."""

    action_size = action_repeat = state_size = 1
    privileged_size = 2
    decision_seconds, max_decisions, cost_sources = 1.0, 20, ()
    action_low, action_high = -np.ones(1), np.ones(1)

    def __init__(self, batch: int) -> None:
        self.batch = batch

    def reset(self, seeds: Sequence[int], rows: Bools | None = None) -> Observation:
        self.goal = np.array([1.0 if seed % 2 else -1.0 for seed in seeds])
        self.place, self.ended = np.zeros(self.batch), np.zeros(self.batch, bool)
        return self._observed()

    def step(self, action: NDArray[Any]) -> Step:
        going = ~self.ended
        self.place = self.place + 0.1 * action[:, 0] * going
        reached = going & (np.abs(self.place - self.goal) < 0.05)
        self.ended = self.ended | reached
        none, count = np.zeros(self.batch, np.int64), going.astype(np.int64)
        return Step(
            self._observed(), np.zeros(self.batch), none.astype(bool), none, {}, reached.astype(np.int64), count, self.ended.copy(), reached
        )

    def _observed(self) -> Observation:
        known = np.stack([self.place, self.goal], 1).astype(np.float32)
        return Observation(None, self.place[:, None].copy(), known)


def pilot() -> Operator:
    """Knows the goal; its `policy` would do nothing."""
    towards = OperatorContext(lambda _: torch.zeros_like, 1, 1.0, informed=lambda _: lambda known: known[:, 1:])
    return Operator.build(1.0, towards, EpisodeNoise(range(ROWS)), ROWS)


def flown(assistant: Assistant) -> Loop:
    seeds = range(ROWS)
    return run_episodes(Line(ROWS), WORLD, pilot(), assistant, seeds, seeds, keep_latents=True)


def test_an_informed_pilot_flies_to_a_goal_that_the_latent_does_not_have():
    loop = flown(HumanOnly())
    assert loop.goals.sum(0).tolist() == [1] * ROWS
    assert loop.h.shape == (len(loop.reward), ROWS, 1)
    assert loop.z.shape[-1] == 0
    assert (np.sign(loop.a_h[0, :, 0]) == [-1, 1, -1, 1, -1, 1]).all()
