"""A picture from behind and above the robot, for people: rendered by MuJoCo with OpenGL. Nothing in it is an observation.

One MuJoCo model, which is only looked at, holds what a `Look` tells of: robot and things are mocap bodies, put where a scene has them.
MuJoCo and OpenGL are imported when the first `View3D` is made. Without OpenGL there is still the map from above (`topdown`).
"""

from __future__ import annotations

import importlib
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from wasp_cli.errors import TaskError, UsageError
from wasp_cli.tasks.base import Pixels
from wasp_cli.tasks.camera.look import Look, Scene
from wasp_cli.tasks.camera.visual_model import OBSTACLES, visual_model

_DISTANCE, _AHEAD = 1.6, 0.5
"""Of the camera: how far it is from what it looks at, and how far that is ahead of the robot, in m."""
_FLATTEST, _STEEPEST = -21.0, -74.0
"""Its pitch in degrees: as flat as walls behind the robot allow; at the steepest it is above the robot."""
_REAR = 0.15
"""How far behind the robot's origin in m the place is that it must see."""
_PARKED = -1000.0
"""Height in m at which a thing waits that is not shown."""
_FURTHER = 2.0
"""How many times the reach of a kind its things are drawn: a pixel is smaller here than in the robot's cameras."""
_NO_GL = "install libegl1 (Debian, Ubuntu), then set MUJOCO_GL=egl or leave it unset; the map from above needs no OpenGL"


class View3D:
    """Renders scenes of one look, each with OpenGL; a context manager. To be used by the thread that made it.

    Args:
        look: what the task looks like.
        width: of the picture in pixels.
        height: of the picture in pixels.

    Raises:
        UsageError: the size is not positive, or OpenGL cannot be used here.
    """

    def __init__(self, look: Look, width: int = 480, height: int = 360) -> None:
        self._gl: Any = None
        self._context: Any = None
        if width < 1 or height < 1:
            raise UsageError(f"a picture of {width} x {height} pixels cannot be drawn", "width and height are at least 1")
        self.size = (width, height)
        self._look = look
        self._counts: tuple[int, ...] | None = None
        with _refusing():
            self._gl = _open_gl(width, height)
            self._gl.make_current()
            self._context = _buffers(None)

    def __enter__(self) -> View3D:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    def close(self) -> None:
        """Give the OpenGL context back; may be called again."""
        gl, self._gl = self._gl, None
        context, self._context = self._context, None
        if context is not None:
            with gl.as_current():
                context.free()
        if gl is not None:
            gl.free()

    def render(self, scene: Scene, row: int) -> Pixels:
        """uint8 [height, width, 3] of one row, seen from behind and above the robot, looking ahead."""
        import mujoco

        if self._gl is None:
            raise TaskError("this view is closed")
        self._gl.make_current()
        counts = tuple(scene.things[kind.name].position.shape[1] if kind.name in scene.things else 0 for kind in self._look.kinds)
        if counts != self._counts:
            self._load(counts)
        model, data = self._model, self._data
        self._place(scene, row)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, self._chase(scene, row), everything, self._scene)
        width, height = self.size
        frame = mujoco.MjrRect(0, 0, width, height)
        picture: Pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(frame, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, frame, self._context)
        # OpenGL's rows go up.
        return np.ascontiguousarray(picture[::-1])

    def _load(self, counts: tuple[int, ...]) -> None:
        """Compile the model for so many things of each kind, and hand it to OpenGL."""
        import mujoco

        self._model = visual_model(self._look, counts, self.size)
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, self._model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = 1
        if self._context is not None:
            self._context.free()
        self._context, self._counts = None, None
        with _refusing():
            self._context = _buffers(self._model)
            self._counts = counts

    def _place(self, scene: Scene, row: int) -> None:
        """The robot is the first mocap body; the things follow in the order of the look's kinds."""
        import mujoco

        positions, rotations = [scene.position[row][None]], [scene.rotation[row][None]]
        for kind in self._look.kinds:
            if kind.name in scene.things:
                things = scene.things[kind.name]
                reach = math.inf if kind.reach is None else _FURTHER * kind.reach
                apart = np.linalg.norm(things.position[row] - scene.position[row], axis=1)
                shown = things.shown[row] & (apart < reach)
                positions.append(np.where(shown[:, None], things.position[row], (0.0, 0.0, _PARKED)))
                rotations.append(things.rotation[row])
        self._data.mocap_pos[:] = np.concatenate(positions)
        for quaternion, rotation in zip(self._data.mocap_quat, np.concatenate(rotations), strict=True):
            mujoco.mju_mat2Quat(quaternion, rotation.ravel())

    def _chase(self, scene: Scene, row: int) -> Any:
        """The camera behind the robot: steeper than usual where a wall would hide the robot."""
        import mujoco

        forward = scene.rotation[row, :2, :2] @ np.array(self._look.forward)
        heading = math.atan2(forward[1], forward[0])
        towards = np.array([math.cos(heading), math.sin(heading), 0.0])
        rear = scene.position[row] - _REAR * towards
        groups = (np.arange(mujoco.mjNGROUP) == OBSTACLES).astype(np.uint8)
        elevation = _FLATTEST
        while elevation > _STEEPEST:
            pitch = math.radians(elevation)
            line = (_AHEAD + _REAR - _DISTANCE * math.cos(pitch)) * towards - (0.0, 0.0, _DISTANCE * math.sin(pitch))
            hit = mujoco.mj_ray(self._model, self._data, rear, line, groups, 1, -1, np.empty(1, np.int32), None)
            if hit < 0.0 or hit > 1.1:
                break
            elevation -= 1.5
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.azimuth, camera.elevation, camera.distance = math.degrees(heading), elevation, _DISTANCE
        camera.lookat[:] = scene.position[row] + _AHEAD * towards
        return camera


def _open_gl(width: int, height: int) -> Any:
    """An OpenGL context of the kind that MUJOCO_GL names now; by default EGL on a Linux machine without a display.

    MuJoCo itself reads MUJOCO_GL only once, when it is imported, and then asks for a display by default.
    """
    import mujoco

    kind = os.environ.get("MUJOCO_GL", "").strip().lower()
    if not kind and sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        kind = "egl"
    module = importlib.import_module(f"mujoco.{kind}") if kind in ("egl", "osmesa", "glfw") else mujoco
    return module.GLContext(width, height)


def _buffers(model: Any) -> Any:
    """What OpenGL keeps of a model (None: an empty one), in the context that is current, with a picture to draw into."""
    import mujoco

    context = mujoco.MjrContext(model or mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
    return context


@contextmanager
def _refusing() -> Iterator[None]:
    """Turn a failure to open OpenGL into an expected error."""
    try:
        yield
    except _gl_failures() as error:
        chosen = os.environ.get("MUJOCO_GL") or "unset"
        raise UsageError(f"no view in 3-D: OpenGL does not work here (MUJOCO_GL: {chosen}): {error}", _NO_GL) from error


def _gl_failures() -> tuple[type[Exception], ...]:
    """What MuJoCo and PyOpenGL raise when a library, a driver or a display is missing."""
    failures: list[type[Exception]] = [ImportError, AttributeError, OSError, RuntimeError]
    for module, name in (("mujoco", "FatalError"), ("OpenGL.error", "Error")):
        if module in sys.modules:
            failures.append(getattr(sys.modules[module], name))
    return tuple(failures)
