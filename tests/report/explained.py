"""An invented episode, decision by decision, for what explains it."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wasp_cli.metrics.episode import GATE_SAFETY, Plans, Trajectory, episode_metrics
from wasp_cli.plan.node import cell_label
from wasp_cli.report.explain.episode import Episode, read_episode
from wasp_cli.report.explain.text import decision_lines, episode_lines
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, Thresholds, write_cell

KEY = "0123456789abcdef0123"
WASP = {
    "horizon": 4,
    "residual_steps": 2,
    "candidates": 30,
    "elites": 10,
    "feasible": 10,
    "search_rollouts": 1,
}
PRINTED = {
    "horizon": 4,
    "residual_steps": 2,
    "candidates": 30,
    "elites": 10,
    "feasible": 10,
    "probe": 20,
}
PLANNING = ("wasp", "printed")
NAN = math.nan


@dataclass
class Invented:
    """An episode under construction: T decisions, of which single ones are changed."""

    steps: int = 8
    method: str = "wasp"
    variant: str = "full"
    thresholds: Thresholds = field(default_factory=lambda: Thresholds(tau_c=0.3, tau_r=0.5))
    config: dict[str, Any] = field(default_factory=lambda: dict(WASP))
    episodes: int = 3

    def __post_init__(self) -> None:
        steps = self.steps
        self.reward = np.arange(steps) / 8
        self.cost_env = np.zeros(steps, int)
        self.goals = np.zeros(steps, int)
        self.a_h = np.tile([0.5, -0.25], (steps, 1))
        self.a = self.a_h.copy()
        self.gate = np.zeros(steps, int)
        gated = self.method in PLANNING
        self.g_cost = np.full(steps, 0.125 if gated else NAN)
        self.g_return = np.full(steps, 1.0 if gated else NAN)
        self.delta_g = np.full(steps, 0.25 if gated else NAN)
        self.signal = np.full(steps, NAN)
        self.plans = Plans(
            np.full((steps, 2, 2), NAN),
            np.full((steps, 3), -1),
            np.zeros((steps, 3), bool),
            *np.full((4, steps), NAN),
        )

    def fire(
        self,
        t: int,
        gate: int,
        residuals: Any = ((-0.5, 0.5), (0.25, 0.0)),
        safe: Any = (3, 12, 30),
        cost: float = 0.2,
        alone: float = 0.6,
    ) -> None:
        """A gate fires at decision t, and its plan is executed; without a search `safe` is -1."""
        plans = self.plans
        self.gate[t] = gate
        if gate == GATE_SAFETY:
            self.g_cost[t], self.delta_g[t] = 0.5, 0.625 if self.method == "wasp" else NAN
        else:
            self.delta_g[t] = 0.75
        plans.residuals[t], plans.safe[t], plans.case2[t] = (
            residuals,
            safe,
            (np.array(safe) >= 0) & (np.array(safe) < 10),
        )
        plans.cost[t], plans.reward[t], plans.alone_cost[t], plans.alone_reward[t] = (
            cost,
            1.5,
            alone,
            1.25,
        )
        self.a[t] = np.clip(self.a_h[t] + plans.residuals[t, 0], -1, 1)

    def pay(self, *decisions: int) -> None:
        """Two env steps with cost in each of some decisions."""
        self.cost_env[list(decisions)] = 2

    def trajectory(self) -> Trajectory:
        return Trajectory(
            reward=self.reward,
            cost=self.cost_env > 0,
            cost_env=self.cost_env,
            env_steps=np.full(self.steps, 4),
            goals=self.goals,
            a_h=self.a_h,
            a=self.a,
            gate=self.gate,
            g_cost=self.g_cost,
            g_return=self.g_return,
            delta_g=self.delta_g,
            signal=self.signal,
            plans=self.plans if self.method in PLANNING else None,
        )

    def manifest(self) -> dict[str, Any]:
        return {
            "kind": "evaluate",
            "key": KEY,
            "label": f"goal1 s0 {cell_label(self.method, self.variant, 'laggy', 0.7)}",
            "axes": {"method": self.method, "method_config": self.config},
            "settings": {"action_repeat": 4, "side_by_side": 2, "returns": {"gamma_c": 0.5}},
            "provenance": {"started_at": "2026-05-01T12:34:56+00:00"},
        }

    def write(self, folder: Path) -> Path:
        trajectory = self.trajectory()
        rows = [episode_metrics(trajectory, 7, 25.0)] * self.episodes
        cell = CellIdentity("goal1", self.method, self.variant, "laggy", 0.7, 0)
        times = [np.full(self.steps, 2.0)] * self.episodes
        return write_cell(
            folder,
            cell,
            [trajectory] * self.episodes,
            rows,
            self.thresholds,
            times,
            range(100, 100 + self.episodes),
        )

    def read(self, folder: Path, manifest: bool = True, episode: int = 0) -> Episode:
        path = self.write(folder)
        return read_episode(
            FoundCell(path, KEY, self.manifest()) if manifest else FoundCell(path), episode
        )

    def store(self, results: Path) -> None:
        """As an artifact."""
        layout = Layout(results)
        layout.prepare()
        staging = staging_folder(layout, KEY)
        self.write(staging)
        commit(layout, "evaluate", KEY, staging, self.manifest())


def text_of(lines: list[Any]) -> str:
    return "\n".join(line.plain.rstrip() for line in lines)


def episode_text(episode: Episode, width: int = 120) -> str:
    return text_of(episode_lines(episode, width))


def decision_text(episode: Episode, t: int, width: int = 400) -> str:
    return text_of(decision_lines(episode, t, width))
