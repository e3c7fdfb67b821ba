"""The table of `wasp bench oracle`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from wasp_cli.metrics.episode import EpisodeMetrics, Trajectory, episode_metrics
from wasp_cli.report.render.text import markdown
from wasp_cli.studies.oracle import Cell, Outcome
from wasp_cli.studies.oracle_run import oracle_table

CELL = Cell("goal1", 0, "laggy", 0.7, 2, 4, 0.99, 0.95, 7, 25.0, Path())


def episode(return_: float, cost: int, goals: int) -> EpisodeMetrics:
    none, nan = np.zeros(4, np.int64), np.full(4, np.nan)
    action = np.zeros((4, 2))
    trajectory = Trajectory(np.zeros(4), none > 0, none, none + 1, none, action, action, none, nan, nan, nan, nan)
    return replace(episode_metrics(trajectory, 7, 25.0), return_=return_, cost=cost, success=goals >= 7)


def test_means_spreads_and_paired_differences() -> None:
    human = Outcome(None, (episode(10.0, 40, 5), episode(14.0, 0, 7)), 3.0)
    whole = Outcome("full", (episode(13.0, 0, 7), episode(16.0, 0, 8)), 90.0)
    safe = Outcome("safety-only", (episode(11.0, 4, 7), episode(14.0, 0, 7)), 60.0)
    text = markdown(oracle_table(CELL, [human, whole, safe]))
    assert "## Oracle dynamics: Goal1, Laggy 0.7, seed 0, 2 episodes" in text
    assert "| Human-only | 12.00 ± 2.83 | 50.0 | 20.00 ± 28.28 | 0.000 | 0.00 |" in text
    assert "| WASP | 14.50 ± 2.12 (+2.50) | 100.0 | 0.00 ± 0.00 (-20.00) |" in text
    assert "| WASP, safety gate only | 12.50 ± 2.12 (+0.50) |" in text
    assert "time: Human-only 3.0 s, WASP 1 min 30 s, WASP, safety gate only 1 min 00 s" in text
    assert human.as_json()["episodes"][0]["return"] == 10.0
    assert human.as_json()["mag_int"] is None
