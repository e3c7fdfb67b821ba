"""What is measured of forces and of changes of hands, against loops over the steps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.metrics.test_episode import columns, trajectory
from wasp_cli.metrics.episode import Trajectory, episode_metrics, pool
from wasp_cli.tasks.motors import Motors

MOTORS = Motors((0.02, 0.5))


def invent(rng: np.random.Generator, steps: int) -> Trajectory:
    """Commands and actions of which many are beyond the motors, some equal, and some equal but for rounding."""
    a_h = rng.uniform(-1, 1, (steps, 2)) * rng.choice([0.02, 1.0], (steps, 1))
    wanted = rng.uniform(-1, 1, (steps, 2))
    kind = rng.integers(0, 4, steps)[:, None]
    a = np.where(kind == 0, a_h, np.where(kind == 1, a_h + 4e-7, np.where(kind == 2, np.sign(a_h) * 0.75, wanted)))
    return trajectory(steps, a_h=a_h, a=np.clip(a, -1, 1))


def loops(episode: Trajectory) -> tuple[list[float], list[float]]:
    """The distance of the forces at every step, and the change of the action at every change of hands."""
    distances, changes = [], []
    before = None
    for t in range(episode.steps):
        acts = math.dist(episode.a[t], episode.a_h[t]) > 1e-6
        apart = math.dist(MOTORS.force(episode.a[t]), MOTORS.force(episode.a_h[t]))
        distances.append(apart if acts and apart > 1e-6 else 0.0)
        if before is not None and acts != before:
            changes.append(math.dist(episode.a[t], episode.a[t - 1]))
        before = acts
    return distances, changes


def mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_rates_of_an_episode_and_of_a_cell_are_ratios_of_sums_over_the_steps(episodes, seed):
    rng = np.random.default_rng(seed)
    parts = [invent(rng, int(rng.integers(1, 12))) for _ in range(episodes)]
    rows = [episode_metrics(part, 1, 25.0, MOTORS.force) for part in parts]
    distances, changes = zip(*map(loops, parts), strict=True)
    for row, apart, jumps in zip(rows, distances, changes, strict=True):
        assert row.int_eff == mean([float(each > 0) for each in apart]) <= row.int_rate
        assert row.mag_eff == pytest.approx(mean(apart))
        assert row.handovers == len(jumps)
        assert row.jump is None if not jumps else row.jump == pytest.approx(mean(jumps))
    pooled = pool(columns(rows))
    assert pooled["int_eff"][0] == pytest.approx(mean([float(each > 0) for apart in distances for each in apart]))
    assert pooled["mag_eff"][0] == pytest.approx(mean([each for apart in distances for each in apart]))
    assert pooled["jump"][0] == pytest.approx(mean([each for jumps in changes for each in jumps]), nan_ok=True)


def test_without_a_change_of_hands_there_is_no_jump_and_without_known_motors_the_action_is_its_force():
    always = trajectory(a=np.full((4, 2), 0.3))
    row = episode_metrics(always, 1, 25.0, Motors().force)
    assert (row.jump, row.handovers) == (None, 0)
    assert (row.int_eff, row.mag_eff) == (row.int_rate, row.mag) == (1.0, pytest.approx(math.hypot(0.3, 0.3)))
    assert row == episode_metrics(always, 1, 25.0)
    quiet = episode_metrics(trajectory(steps=1), 1, 25.0, MOTORS.force)
    assert (quiet.int_eff, quiet.mag_eff, quiet.jump) == (0.0, 0.0, None)
