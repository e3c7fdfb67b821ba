"""The view from behind: what is left is left, the robot is seen, and a machine without OpenGL is told what to do."""

from __future__ import annotations

import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from wasp_cli.errors import TaskError, UsageError
from wasp_cli.tasks.camera.look import Look, Scene, Things
from wasp_cli.tasks.camera.view3d import View3D
from wasp_cli.tasks.camera.visual_model import visual_model
from wasp_cli.tasks.driver import drive
from wasp_cli.tasks.formula import track
from wasp_cli.tasks.formula.look import look as formula_look
from wasp_cli.tasks.goal.look import look as goal_look
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.outline import inside
from wasp_cli.tasks.race.look import look as race_look
from wasp_cli.tasks.views import CHASE_SIZE, Viewer, from_above

WIDTH, HEIGHT = 160, 120


def opened(look: Look) -> View3D | None:
    """A view, or nothing on a machine without OpenGL: there the error must say what to do."""
    try:
        return View3D(look, WIDTH, HEIGHT)
    except UsageError as error:
        check(error)
        return None


def check(error: UsageError) -> None:
    """It says what is wrong and what to do."""
    assert "OpenGL does not work here" in error.message
    assert "MUJOCO_GL=egl" in (error.hint or "")


def scene(look: Look, at=(0.0, 0.0), heading=0.0, shown=True, **things) -> Scene:
    yaw = heading - np.arctan2(look.forward[1], look.forward[0])
    c, s = np.cos(yaw), np.sin(yaw)
    placed = {}
    for name, where in things.items():
        position = np.array([[(*place, 0.1) for place in where]])
        count = position.shape[:2]
        placed[name] = Things(position, np.broadcast_to(np.eye(3), (*count, 3, 3)), np.full(count, shown))
    return Scene(np.array([[*at, 0.1]]), np.array([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]]), placed)


def reddish(image: np.ndarray) -> np.ndarray:
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    return (red > 2 * green + 30) & (red > 2 * blue + 30)


@pytest.mark.parametrize(
    ("look", "at", "heading"),
    [(goal_look(0), (0.3, -0.4), 2.5), (race_look(0), (-0.5, 1.1), 0.0), (formula_look(0), tuple(track.STAGES[2]), 0.7)],
)
def test_left_is_left_and_the_robot_is_in_the_middle(look, at, heading):
    view = opened(look)
    if view is None:
        return
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    with view:
        empty = view.render(scene(look, at, heading), 0)
        assert empty.shape == (HEIGHT, WIDTH, 3)
        assert empty.dtype == np.uint8
        robot = reddish(empty[HEIGHT // 3 :, WIDTH // 3 : -WIDTH // 3])
        assert robot.sum() > 100
        for side in (1.0, -1.0):
            where = np.array(at) + 2.0 * ahead + 0.4 * side * left
            image = view.render(scene(look, at, heading, goal=[where]), 0)
            columns = np.nonzero((image != empty).any(axis=-1))[1]
            assert len(columns) > 20
            assert (columns.mean() - WIDTH / 2) * side < -5.0
        # As many things as before, and others: the same scene gives the same picture.
        assert (view.render(scene(look, at, heading), 0) == empty).all()
        assert (view.render(scene(look, at, heading, shown=False, goal=[where]), 0) == empty).all()
    view.close()
    with pytest.raises(TaskError, match="closed"):
        view.render(scene(look, at, heading), 0)


def test_a_wall_at_its_back_does_not_hide_the_robot():
    look = race_look(0)
    view = opened(look)
    if view is None:
        return
    with view:
        for at, heading in (((0.0, 0.85), np.pi / 2), ((0.0, 1.4), -np.pi / 2), ((-2.4, 1.0), 0.0)):
            robot = reddish(view.render(scene(look, at, heading), 0)[:, WIDTH // 3 : -WIDTH // 3])
            assert robot.sum() > 100


@pytest.mark.parametrize("look", [goal_look(2), race_look(1), formula_look(1)])
def test_the_model_holds_everything(look):
    counts = tuple(range(2, 2 + len(look.kinds)))
    model = visual_model(look, counts, (WIDTH, HEIGHT))
    assert model.nmocap == 1 + sum(counts)
    data = mujoco.MjData(model)
    data.mocap_pos[:, 2] = -1000.0
    mujoco.mj_kinematics(model, data)

    def height(x: float, y: float) -> float:
        down = np.array([0.0, 0.0, -1.0])
        return 10.0 - mujoco.mj_ray(model, data, np.array([x, y, 10.0]), down, None, 1, -1, np.zeros(1, np.int32), None)

    for wall in look.walls:
        ends = np.roll(wall.outline, -1, axis=0)
        along = ends - wall.outline
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        for side in (1.0, -1.0):
            places = (wall.outline + ends) / 2 + 0.03 * side * normal
            heights = np.array([height(*place) for place in places])
            # Of all walls that a place lies in, the highest is seen from above.
            solid = np.stack([inside(places, each.outline) != each.hollow for each in look.walls])
            expected = (solid * np.array([[each.top] for each in look.walls])).max(axis=0)
            assert np.mean(np.abs(heights - expected) < 1e-3) > 0.95
    for mark in look.landmarks:
        assert height(*mark.xy) == pytest.approx(mark.top)


@pytest.mark.parametrize("name", ["goal1", "race1", "formula1"])
def test_a_task_is_drawn_and_no_snapshot_knows(name):
    task = make_task(name, 2, observe=("state",))
    task.reset([3, 4])
    task.step(drive(task))
    before = task.snapshot()
    viewer = Viewer(task, "chase")
    try:
        first, second = viewer.draw(0), viewer.draw(1)
    except UsageError as error:
        check(error)
    else:
        assert first.shape == (CHASE_SIZE[1], CHASE_SIZE[0], 3)
        assert (first != second).any()
    viewer.close()
    assert from_above(task, 1, 64).shape == (64, 64, 3)
    after = task.snapshot()
    assert before.keys() == after.keys()
    assert all((before[key] == after[key]).all() for key in before)


ASK = """
import os, sys
from wasp_cli.errors import UsageError
from wasp_cli.tasks.camera.look import Look, Part, Scene
from wasp_cli.tasks.camera.view3d import View3D
import numpy as np
if sys.argv[1] != "now":
    import mujoco
    os.environ["MUJOCO_GL"] = sys.argv[1]
assert "OpenGL" not in sys.modules or sys.argv[1] == "now"

class Grey:
    def paint(self, x, y, footprint):
        return np.full((3, len(x)), 0.5, np.float32)

look = Look((Part('<geom size="0.1"/>', (1.0, 0.0, 0.0)),), 0.1, (1.0, 0.0), Grey(), (), (), (), 2.0)
try:
    view = View3D(look, 64, 48)
except UsageError as error:
    assert "OpenGL does not work here" in error.message and "libegl1" in error.hint, error
    print("refused")
else:
    # Never closed: nothing may be said about that at the end.
    assert np.ptp(view.render(Scene(np.array([[0.0, 0.0, 0.1]]), np.eye(3)[None], {}), 0)) > 100
    print("picture")
"""


def ask(late: str | None = None, **environment: str) -> str:
    """`picture` or `refused`, of a process of its own; `late`: MUJOCO_GL is set to that when MuJoCo has been imported already."""
    clean = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID")}
    done = subprocess.run(
        [sys.executable, "-c", ASK, "now" if late is None else late], env=clean | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("kind", ["egl", "osmesa", "glfw"])
def test_each_kind_of_opengl_gives_a_picture_or_a_clear_error(kind):
    assert ask(MUJOCO_GL=kind) in ("picture", "refused")


def test_egl_is_found_without_being_asked_for_and_after_mujoco_is_imported():
    headless = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    egl = ask(MUJOCO_GL="egl", **headless)
    assert ask(late="egl", **headless) == egl
    if sys.platform == "linux":
        assert ask(**headless) == egl


@pytest.mark.parametrize(
    "environment",
    [
        {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "999"},
        {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"},
        {"MUJOCO_GL": "off"},
        {"MUJOCO_GL": "nonsense"},
    ],
)
def test_what_cannot_work_is_refused(environment):
    assert ask(**environment) == "refused"
