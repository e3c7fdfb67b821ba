"""`wasp list` and `wasp draw`: the lists, the picture of a layout, what they say to wrong input."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.commands import run_here
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.registry import TASKS


def test_the_lists_say_what_each_is() -> None:
    listed = json.loads(run_here("list", "--json", columns=200).stdout)
    names = {kind: [info["name"] for info in rows] for kind, rows in listed.items()}
    assert names == {"methods": list(METHODS), "operators": list(OPERATORS), "tasks": list(TASKS)}
    assert (
        json.loads(run_here("list", "operators", "--json", columns=200).stdout)
        == listed["operators"]
    )
    goal = next(task for task in listed["tasks"] if task["name"] == "goal1")
    assert (goal["gym_id"], goal["state_size"], goal["pixels_shape"]) == (
        "wasp/SafetyPointGoal1-v0",
        60,
        [6, 64, 64],
    )
    assert (goal["action_low"], goal["action_high"], goal["cost_sources"]) == (
        [-1.0, -1.0],
        [1.0, 1.0],
        ["hazards"],
    )
    assert (goal["env_steps"], goal["seconds"], goal["success_goals"]) == (1000, 20.0, 7)
    shown = run_here("list", columns=200).stdout
    for word in (
        *METHODS,
        *OPERATORS,
        *TASKS,
        *(info.gym_id for info in TASKS.values()),
        "no-case2",
        "delay in seconds",
        "SafeRL-Res",
        "residual",
        "(denoiser)",
        "docs/extending.md",
        "state 60",
        "pixels 6x64x64",
        f"privileged {goal['privileged_size']}",
        "action 2 in ±1",
        "1000 steps",
        "7 goals",
    ):
        assert word in shown
    assert not [word for word in ("Limited skill", "from wasp_cli") if word in shown]


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def contains(sheet: np.ndarray, image: np.ndarray) -> bool:
    """Whether a picture lies somewhere in a larger one, pixel for pixel."""
    windows = np.lib.stride_tricks.sliding_window_view(sheet, (1, image.shape[1], 3))[:, :, 0]
    rows, columns = np.nonzero((windows == image[0]).all((2, 3, 4)))
    height, width = image.shape[:2]
    return any(
        (sheet[r : r + height, c : c + width] == image).all()
        for r, c in zip(rows, columns, strict=True)
    )


@pytest.mark.parametrize(
    ("task", "cameras"), [("goal1", 2), ("wasp/SafetyPointGoal1-v0", 2), ("puddle:Puddle-v0", 1)]
)
def test_a_sheet_shows_what_the_cameras_see(task: str, cameras: int, tmp_path: Path) -> None:
    done = run_here("draw", task, "--seed", "3", "--out", tmp_path / "map.png", columns=200)
    assert (done.exit_code, done.stdout.strip()) == (0, str(tmp_path / "map.png")), done.stderr
    pixels = (
        make_task("goal1" if "Goal1" in task else task, 1, observe=("pixels",)).reset([3]).pixels[0]
    )
    for camera in range(cameras):
        image = np.moveaxis(pixels[3 * camera : 3 * camera + 3], 0, -1)
        assert contains(read(tmp_path / "map.png"), image.repeat(4, 0).repeat(4, 1))


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["gaol1"], 2, "unknown task 'gaol1'\n       did you mean 'goal"),
        (["wasp/SafetyPointGaol1-v0"], 2, "did you mean 'goal1'"),
        (["puddle:Pudle-v0"], 2, "did you mean 'puddle:Puddle-v0'?"),
        (["goal1", "--seed", "-1"], 2, "Invalid value for '--seed'"),
        (["goal1", "--out", "map.txt"], 2, "'map.txt' is no name of a picture"),
        (["nowhere:MyEnv-v0"], 1, "module 'nowhere' does not import"),
        (["goal1", "--out", "no/such/folder/map.png"], 2, "create the folder 'no/such/folder'"),
        (["SafetyPointGoal3-v0"], 2, "did you mean 'goal0'"),
        (["../../etc/passwd"], 2, "no task and no gymnasium id is called"),
    ],
)
def test_what_cannot_be_shown_is_said(arguments: list[str], code: int, expected: str) -> None:
    done = run_here("draw", *arguments, columns=200)
    assert (done.exit_code, done.stdout) == (code, ""), done.stderr
    assert expected in done.stderr
