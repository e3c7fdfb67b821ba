"""Goal1 against a recorded episode of the reference package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from wasp_cli.tasks import conformance, goal1_conformance
from wasp_cli.tasks.comparison import compare
from wasp_cli.tasks.goal1 import Goal1


def test_every_quantity_of_the_recording_is_within_tolerance(recording):
    checks = goal1_conformance.check_point_goal(recording)

    assert [check for check in checks if not check.ok] == []
    assert {"xy after one step", "reward, vase untouched", "cost", "goal, all steps", "hazards_lidar"} <= {c.quantity for c in checks}
    # The recording has what makes these checks mean something.
    assert recording["cost"].sum() > 10
    assert recording["goal_met"].sum() == 2
    assert recording["n_vase_contacts"].sum() > 10


def test_the_layout_of_a_seed_is_bit_exact(recording):
    task = Goal1(2, observe=())
    task.reset([7, 0])
    start = task.snapshot()

    assert start["qpos"][1, :2].tolist() == recording["layout_agent_xy"].tolist()
    assert start["qpos"][1, 2] == recording["layout_agent_rot"]
    assert start["goal"][1].tolist() == recording["layout_goal_xy"].tolist()
    assert start["hazards"][1].tolist() == recording["layout_hazards_xy"].tolist()
    assert start["qpos"][1, 3:5].tolist() == recording["layout_vases_xy"][0].tolist()


def test_the_command_reports_and_passes(recorded_folder: Path, capsys):
    assert conformance.main([str(recorded_folder)]) == 0

    out = capsys.readouterr().out
    assert "PointGoal1_seed0.npz" in out
    assert "FAILED" not in out


def test_the_command_fails_on_a_wrong_recording_and_skips_unknown_ones(recording, tmp_path: Path, capsys):
    np.savez(tmp_path / "wrong.npz", **{**recording, "cost": 1 - recording["cost"]})
    np.savez(tmp_path / "boat.npz", meta='{"task": "SafetyBoatGoal1-v0"}')

    assert conformance.main([str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "FAILED" in out
    assert "boat.npz                     skipped" in out


@pytest.mark.parametrize("arguments", [[], ["no-such-folder"]])
def test_the_command_explains_its_usage(arguments, capsys):
    assert conformance.main(arguments) == 2
    assert "usage" in capsys.readouterr().err


def test_nothing_checked_is_not_a_success(tmp_path: Path):
    assert conformance.main([str(tmp_path)]) == 1


def test_nan_is_out_of_tolerance():
    assert not compare("q", [np.nan], [0.0], 1.0).ok
    assert not compare("q", [], [], 1.0).ok
    with pytest.raises(ValueError, match="shapes"):
        compare("q", [1.0], [1.0, 2.0], 1.0)
