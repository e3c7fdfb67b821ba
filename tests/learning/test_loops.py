"""Vector environments and the closed loop over episodes that end at different times, with a
world model and without one.
"""

from collections import deque
from collections.abc import Sequence
from itertools import count, product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from tests.learning.recordings import recording
from wasp_cli.errors import WaspError
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.configs import ResidualConfig
from wasp_cli.learning.configs.fallback import FallbackConfig
from wasp_cli.learning.configs.reachability import ReachabilityConfig
from wasp_cli.learning.dataset import record
from wasp_cli.learning.evaluation import trajectories
from wasp_cli.learning.fallback import fallback_quality, train_fallback
from wasp_cli.learning.foresight import foresight
from wasp_cli.learning.heldout import load_heldout, save_heldout
from wasp_cli.learning.latents import Latents
from wasp_cli.learning.nominal import heldout_rows
from wasp_cli.learning.reachability import train_safety_value
from wasp_cli.learning.residual import AssistedTask
from wasp_cli.learning.vec_env import TaskVecEnv
from wasp_cli.methods.base import Decision
from wasp_cli.methods.human import HumanOnly
from wasp_cli.models.base import Latent
from wasp_cli.models.policy import Skills
from wasp_cli.models.reachability import SafetyValue, danger_target
from wasp_cli.models.state import StateWorld
from wasp_cli.operators.base import EpisodeNoise, Operator, OperatorContext, build_operator
from wasp_cli.stages.base import no_progress
from wasp_cli.tasks.base import Bools, Observation, Step


class Staggered:
    """A task whose episode of seed s lasts 2 + s % 4 decisions; observations name (seed, step); the
    reward is the first action.

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
            [
                np.random.default_rng([s, t]).integers(0, 256, (6, 64, 64), dtype=np.uint8)
                for s, t in zip(self.seed, self.t, strict=True)
            ]
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
            self.see(),
            np.where(live, action[:, 0], 0.0),
            cost,
            3 * cost.astype(np.int64),
            {"hazards": cost.astype(np.int64)},
            0 * ones,
            4 * ones,
            self.over.copy(),
            self.over & (self.seed % 2 == 1),
        )


def test_episodes_restart_row_by_row_with_their_terminal_observation():
    env = TaskVecEnv(Staggered(3), 3, -1.0, 1.0, count().__next__)
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
    """Restarting some rows must leave the filter, the operators and their noise of the others
    where they were.
    """

    def drive(rows: Sequence[int], steps: int) -> np.ndarray:
        config = ResidualConfig(operators=operators)
        env = AssistedTask(Staggered(len(rows)), parts.world_model, parts.skills, config, "t", 0)
        lines = {row: iter(range(row, 1000, 4)) for row in rows}
        owners: deque[int] = deque()

        def following() -> int:
            return next(lines[owners.popleft()])

        env._next_seed = env._noise_seed = following
        seen = []
        owners.extend([*rows, *rows])
        seen.append(env.reset())
        for _ in range(steps):
            env.step_async(np.full((len(rows), 2), 0.1, np.float32))
            t = env.task.t + 1
            ending = [
                row
                for row, s, step in zip(rows, env.task.seed, t, strict=True)
                if step >= 2 + s % 4
            ]
            owners.extend([*ending, *ending])
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
    operator = build_operator(
        "noisy", 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise([0]), 1
    )
    with pytest.raises(WaspError, match="'Changing' changed the operator's command in place"):
        run_episodes(Staggered(1), parts.world_model, operator, Changing(), [0], [0])


def test_the_closed_loop_cuts_every_episode_at_its_end(parts, tmp_path):
    seeds = [0, 1, 2, 3]
    task = Staggered(4)
    operator = build_operator(
        "noisy", 0.5, OperatorContext(parts.skills.at, 2, 0.08), EpisodeNoise(seeds), 4
    )
    loop = run_episodes(
        task, parts.world_model, operator, HumanOnly(), seeds, seeds, keep_latents=True
    )
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
        actions.append(
            np.random.default_rng(len(actions)).uniform(-1, 1, (3, 2)).astype(np.float32)
        )
        return actions[-1]

    data = record(Staggered(3), [0, 1, 3], command, ["expert", "noisy", "noisy"], number=7)
    assert data.episode.tolist() == [7] * 3 + [8] * 4 + [9] * 6
    assert np.flatnonzero(data.first).tolist() == [0, 3, 7]
    assert data.privileged[:, 1].tolist() == [*range(3), *range(4), *range(6)]
    # the first episode was cut off, the others ended by their rule
    assert np.flatnonzero(data.terminal).tolist() == [6, 12]
    np.testing.assert_array_equal(data.action[3:7], [[0, 0], *(a[1] for a in actions[:3])])
    np.testing.assert_allclose(data.reward[1:3], [a[0, 0] for a in actions[:2]], rtol=1e-6)
    assert np.flatnonzero(data.cost_env).tolist() == [2, 5, 9]


ROWS = 6


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
            self._observed(),
            np.zeros(self.batch),
            none.astype(bool),
            none,
            {},
            reached.astype(np.int64),
            count,
            self.ended.copy(),
            reached,
        )

    def _observed(self) -> Observation:
        known = np.stack([self.place, self.goal], 1).astype(np.float32)
        return Observation(None, self.place[:, None].copy(), known)


def pilot() -> Operator:
    """Knows the goal; its `policy` would do nothing."""
    towards = OperatorContext(
        lambda _: torch.zeros_like, 1, 1.0, informed=lambda _: lambda known: known[:, 1:]
    )
    return Operator.build(1.0, towards, EpisodeNoise(range(ROWS)), ROWS)


def test_an_informed_pilot_flies_to_a_goal_that_the_latent_does_not_have():
    loop = run_episodes(
        Line(ROWS),
        StateWorld(1, 1),
        pilot(),
        HumanOnly(),
        range(ROWS),
        range(ROWS),
        keep_latents=True,
    )
    assert loop.goals.sum(0).tolist() == [1] * ROWS
    assert loop.h.shape == (len(loop.reward), ROWS, 1)
    assert loop.z.shape[-1] == 0
    assert (np.sign(loop.a_h[0, :, 0]) == [-1, 1, -1, 1, -1, 1]).all()


# The safety value: its Bellman target against brute force, and what is learned of it in a world
# that can be searched.


GAMMA = 0.9
LENGTHS = (6,) * 200


def fixed_point(arrive: Tensor, cost: Tensor, gamma: float) -> Tensor:
    """The danger [S, K] of actions in a world of S states: `arrive` [S, K] is where they lead,
    `cost` [S] what arriving there costs.
    """
    danger = torch.zeros(arrive.shape, dtype=torch.float64)
    for _ in range(2000):
        danger = danger_target(cost[arrive], danger.min(1).values[arrive], gamma)
    return danger


def test_a_failure_that_cannot_be_avoided_is_worth_less_the_further_it_is():
    """On a slope every action leads one state down, and state 0 fails: its danger k decisions
    away is gamma^(k - 1).
    """
    states = 8
    arrive = (torch.arange(states) - 1).clamp(min=0).unsqueeze(1)
    cost = (torch.arange(states) == 0).double()
    found = fixed_point(arrive, cost, GAMMA)[:, 0]
    assert found.tolist() == pytest.approx([1.0, *(GAMMA**k for k in range(states - 1))])


def test_the_fixed_point_is_when_the_best_plan_fails_first():
    """Brute force over all plans in a random world: gamma^(k - 1) where the plan that fails
    last fails in its k-th decision.
    """
    source = torch.Generator().manual_seed(1)
    # what lies beyond twelve decisions weighs 1 / 4096
    states, actions, length, gamma = 12, 2, 12, 0.5
    arrive = torch.randint(states, (states, actions), generator=source)
    cost = (torch.rand(states, generator=source) < 0.3).double()
    found = fixed_point(arrive, cost, gamma)
    plans = torch.tensor(list(product(range(actions), repeat=length)))
    different = set()
    for state, first in product(range(states), range(actions)):
        at, danger = torch.full((len(plans),), state), torch.zeros(len(plans), dtype=torch.float64)
        for k in range(length):
            at = arrive[at, plans[:, k]]
            danger = danger.where((danger > 0) | (cost[at] == 0), gamma**k)
        best = float(danger[plans[:, 0] == first].min())
        different.add(best)
        assert float(found[state, first]) == pytest.approx(best, abs=1e-3)
    assert len(different) >= 5, "a world in which everything or nothing fails shows nothing"


def test_a_value_is_the_lower_of_two_and_never_outside_of_what_margins_can_be():
    torch.manual_seed(0)
    value = SafetyValue(5, 2, 8, (1.0, 0.1))
    features, actions = torch.randn(6, 5), 2 * torch.rand(6, 4, 2) - 1
    each = 1 - 2 * value.logits(features, actions).sigmoid()
    assert torch.equal(value(features, actions), each.amin(0))
    assert value(100 * features, actions).abs().max() <= 1
    fallback, best = value.fallback(features)
    torch.testing.assert_close(value(features, fallback.unsqueeze(1))[:, 0], best)
    assert (value(features, value.extremes.unsqueeze(0)) <= best.unsqueeze(1) + 1e-6).all()


class Brakes:
    """A vehicle at x with speed v, which the first component of an action changes by up to 0.1:
    it fails beyond x = 1.
    """

    action_size, noise_size, feature_size = 2, 1, 4
    sizes = SimpleNamespace(action_scales=(1.0,))

    def imagine(self, latent: Latent, action: Tensor, noise: Tensor) -> Latent:
        v = (latent.h[:, 1] + 0.1 * action[:, 0]).clamp(-0.5, 0.5)
        return Latent(torch.stack([(latent.h[:, 0] + v).clamp(-1, 1.5), v], -1), latent.z)

    def cost(self, latent: Latent) -> Tensor:
        return (latent.h[:, 0] > 1).float()

    def continues(self, latent: Latent) -> Tensor:
        return torch.ones(len(latent.h))


def driven() -> tuple[Latents, np.ndarray, np.ndarray]:
    """Latents [N] of a vehicle under random commands that last, and the commands and costs of
    those rows.
    """
    recorded, world, source = recording(LENGTHS), Brakes(), np.random.default_rng(1)
    h, cost = (
        np.zeros((len(recorded.first), 2), np.float32),
        np.zeros(len(recorded.first), np.float32),
    )
    for row, begins in enumerate(recorded.first):
        if begins:
            h[row] = source.uniform(-0.9, 1.0), source.uniform(-0.5, 0.5)
        else:
            before = Latent(torch.from_numpy(h[row - 1 : row]), torch.zeros(1, 2))
            latent = world.imagine(
                before, torch.from_numpy(recorded.action[row : row + 1]), torch.zeros(1, 1)
            )
            h[row], cost[row] = latent.h[0].numpy(), float(world.cost(latent))
    return (
        Latents(torch.from_numpy(h), torch.zeros(len(h), 1, dtype=torch.uint8), 2),
        recorded.action,
        cost,
    )


def braked(x: float, v: float) -> float:
    """The danger of full braking from (x, v) on, the best plan: none, or gamma^(k - 1) where x
    = 1 is passed in the k-th decision.
    """
    for k in range(12):
        v = max(v - 0.1, -0.5)
        x += v
        if x > 1:
            return float(GAMMA**k)
    return 0.0


def test_training_finds_from_where_braking_comes_too_late():
    latents, action, cost = driven()
    told = recording(LENGTHS)._replace(action=action, cost=cost)
    torch.manual_seed(0)
    config = ReachabilityConfig(
        hidden=32, updates=500, batch=64, gamma=GAMMA, slow=0.1, learning_rate=3e-3
    )
    value, curve = train_safety_value(
        Brakes(), Skills([1.0], 4, [4], 2), told, latents, config, 1, no_progress
    )
    assert curve[-1]["loss"] < 0.7 * curve[0]["loss"]
    grid = [(x, v) for x in np.linspace(-0.5, 0.9, 12) for v in np.linspace(-0.2, 0.4, 8)]
    features = torch.tensor([(x, v, 1.0, 0.0) for x, v in grid], dtype=torch.float32)
    wanted = np.array([braked(x, v) for x, v in grid])
    found = (1 - value.fallback(features)[1].numpy()) / 2
    lost, saved = found[wanted > 0.8], found[wanted == 0]
    assert np.mean(lost > 0.5) > 0.8
    assert np.mean(saved < 0.5) > 0.9
    assert np.abs(found - wanted).mean() < 0.15
    # Near the edge the fallback brakes.
    edge = features[(wanted == 0) & (features[:, 1].numpy() > 0.2) & (features[:, 0].numpy() > 0.2)]
    assert (value.fallback(edge)[0][:, 0] < 0).float().mean() > 0.8


def test_actor_and_critic_find_together_from_where_braking_comes_too_late():
    latents, action, cost = driven()
    told = recording(LENGTHS)._replace(action=action, cost=cost)
    torch.manual_seed(0)
    config = FallbackConfig(
        hidden=32, updates=700, batch=64, gamma=GAMMA, slow=0.1, learning_rate=3e-3
    )
    value, actor, curve = train_fallback(
        Brakes(), Skills([1.0], 4, [4], 2), told, latents, config, 1, no_progress
    )
    assert curve[-1]["loss"] < 0.7 * curve[0]["loss"]
    grid = [(x, v) for x in np.linspace(-0.5, 0.9, 12) for v in np.linspace(-0.2, 0.4, 8)]
    features = torch.tensor([(x, v, 1.0, 0.0) for x, v in grid], dtype=torch.float32)
    wanted = np.array([braked(x, v) for x, v in grid])
    chosen = actor(features)
    found = (1 - value(features, chosen.unsqueeze(1)).squeeze(1).numpy()) / 2
    lost, saved = found[wanted > 0.8], found[wanted == 0]
    assert np.mean(lost > 0.5) > 0.8
    assert np.mean(saved < 0.5) > 0.9
    assert np.abs(found - wanted).mean() < 0.15
    # Near the edge the actor brakes, and is worth about what the safest extreme action is.
    edge = (wanted == 0) & (features[:, 1].numpy() > 0.2) & (features[:, 0].numpy() > 0.2)
    assert (chosen[edge][:, 0] < -0.5).float().mean() > 0.8
    judged = fallback_quality(value, actor, features)
    assert judged["actor"] == pytest.approx(judged["extreme"], abs=0.1)


def test_the_figures_of_a_value_that_knows_and_of_one_that_does_not():
    source = np.random.default_rng(0)
    episode = np.repeat(np.arange(20), 60)
    cost = np.zeros(1200)
    cost[30::60] = 1
    near = np.array(
        [max(0.0, 1 - abs(30 - t % 60) / 15) if t % 60 <= 30 else 0.0 for t in range(1200)]
    )
    both = (foresight(-near, cost, episode), foresight(source.random(1200), cost, episode))
    knows, guesses = (
        {name: value for name, value in one.items() if value is not None} for one in both
    )
    assert knows["auc"] > 0.99
    assert knows["foreseen_5"] == 1.0
    assert guesses["auc"] == pytest.approx(0.5, abs=0.06)
    assert guesses["foreseen_0"] < 0.3
    assert foresight(-near, np.zeros(1200), episode)["auc"] is None
    constant = foresight(np.zeros(1200), cost, episode)
    assert constant["auc"] == pytest.approx(0.5)  # ties are neither
    assert constant["ap"] == pytest.approx(constant["costly"])
