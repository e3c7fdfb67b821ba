"""`wasp list` and `wasp draw` from outside: the lists, the picture of a layout, what they say to wrong input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"


def wasp(*arguments: str | Path, folder: Path = EXAMPLES, columns: int = 200) -> subprocess.CompletedProcess[str]:
    """Run `wasp` as its console script does: with `-P`, Python does not search the current folder by itself."""
    variables = {**os.environ, "COLUMNS": str(columns), "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "wasp_cli", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600, env=variables, check=False)


def test_the_list_says_what_each_task_is() -> None:
    done = wasp("list", "tasks")
    assert done.returncode == 0, done.stderr
    task = make_task("goal1", 1, observe=())
    for info in TASKS.values():
        assert info.name in done.stdout
        assert info.gym_id in done.stdout
    for words in ("state 60", "pixels 6x64x64", f"privileged {task.privileged_size}", "action 2 in ±1", "1000 steps", "7 goals"):
        assert words in done.stdout
    # What goes into a pipe is as complete as on a wide screen.
    assert wasp("list", "tasks", columns=80).stdout.split() == done.stdout.split()


def test_the_list_for_machines() -> None:
    found = {task["name"]: task for task in json.loads(wasp("list", "tasks", "--json").stdout)}
    assert list(found) == list(TASKS)
    goal = found["goal1"]
    assert (goal["gym_id"], goal["state_size"], goal["pixels_shape"]) == ("wasp/SafetyPointGoal1-v0", 60, [6, 64, 64])
    assert (goal["action_low"], goal["action_high"], goal["cost_sources"]) == ([-1.0, -1.0], [1.0, 1.0], ["hazards"])
    assert (goal["env_steps"], goal["seconds"], goal["success_goals"]) == (1000, 20.0, 7)


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def contains(sheet: np.ndarray, image: np.ndarray) -> bool:
    """Whether a picture lies somewhere in a larger one, pixel for pixel."""
    windows = np.lib.stride_tricks.sliding_window_view(sheet, (1, image.shape[1], 3))[:, :, 0]
    rows, columns = np.nonzero((windows == image[0]).all((2, 3, 4)))
    height, width = image.shape[:2]
    return any((sheet[r : r + height, c : c + width] == image).all() for r, c in zip(rows, columns, strict=True))


def test_a_sheet_shows_the_map_and_both_cameras(tmp_path: Path) -> None:
    done = wasp("draw", "goal1", "--seed", "3", "--out", tmp_path / "map.png")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(tmp_path / "map.png")
    sheet = read(tmp_path / "map.png")
    pixels = make_task("goal1", 1, observe=("pixels",)).reset([3]).pixels[0]
    for camera in (pixels[:3], pixels[3:]):
        assert contains(sheet, np.moveaxis(camera, 0, -1).repeat(4, 0).repeat(4, 1))
    other = wasp("draw", "wasp/SafetyPointGoal1-v0", "--seed", "3", "--out", tmp_path / "same.png")
    assert other.returncode == 0, other.stderr
    assert (tmp_path / "same.png").read_bytes() == (tmp_path / "map.png").read_bytes()


def test_a_sheet_of_anothers_environment_shows_its_camera(tmp_path: Path) -> None:
    done = wasp("draw", "puddle:Puddle-v0", "--seed", "2", "--out", tmp_path / "p.png")
    assert done.returncode == 0, done.stderr
    pixels = make_task("puddle:Puddle-v0", 1, observe=("pixels",)).reset([2]).pixels[0]
    assert contains(read(tmp_path / "p.png"), np.moveaxis(pixels[:3], 0, -1).repeat(4, 0).repeat(4, 1))


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["gaol1"], 2, "unknown task 'gaol1'\n       did you mean 'goal"),
        (["wasp/SafetyPointGaol1-v0"], 2, "did you mean 'wasp/SafetyPointGoal1-v0'"),
        (["puddle:Pudle-v0"], 2, "did you mean 'Puddle-v0'?"),
        (["goal1", "--seed", "-1"], 2, "Invalid value for '--seed'"),
        (["goal1", "--out", "map.txt"], 2, "'map.txt' is no name of a picture"),
        (["nowhere:MyEnv-v0"], 1, "module 'nowhere' does not import"),
        (["goal1", "--out", "no/such/folder/map.png"], 2, "create the folder 'no/such/folder'"),
        (["SafetyPointGoal3-v0"], 2, "'wasp/SafetyPointGoal1-v0'"),
        (["../../etc/passwd"], 2, "no task and no gymnasium id is called"),
    ],
)
def test_what_cannot_be_shown_is_said(arguments: list[str], code: int, expected: str) -> None:
    done = wasp("draw", *arguments)
    assert done.returncode == code, done.stderr
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("arguments", [["list"], ["draw", "goal1"], ["draw", "race1", "--steps", "3"]])
def test_mujoco_that_does_not_import_is_said(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "foo")
    done = wasp(*arguments, folder=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "MuJoCo does not import with MUJOCO_GL=foo" in done.stderr
    assert "unset MUJOCO_GL" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_all_three_are_listed_where_none_is_named() -> None:
    listed = json.loads(wasp("list", "--json").stdout)
    names = {kind: [info["name"] for info in rows] for kind, rows in listed.items()}
    assert names == {"methods": list(METHODS), "operators": list(OPERATORS), "tasks": list(TASKS)}
    assert json.loads(wasp("list", "operators", "--json").stdout) == listed["operators"]
    shown = wasp("list").stdout
    assert all(name in shown for name in (*METHODS, *OPERATORS, "no-case2", "delay in seconds"))
    assert all(word in shown for word in ("SafeRL-Res", "residual", "(denoiser)", "docs/extending.md"))
    assert not [word for word in ("Limited skill", "from wasp_cli") if word in shown]
