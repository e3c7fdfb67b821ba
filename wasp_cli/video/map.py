"""The map of a running episode with arrows, trails and marks; and the typeface of every picture.

The map of a small task stands still. That of a large one follows the robot, which moves freely
within its middle. Everything is drawn twice as large as it is shown, which smooths its edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from wasp_cli.report.canvas import load_matplotlib
from wasp_cli.tasks.base import Floats, Pixels
from wasp_cli.tasks.camera.appearance import Appearance, Scene
from wasp_cli.tasks.make import require_mujoco

# Colours of what the operator commands, of what is executed instead, and of costs: of Okabe and
# Ito, distinguishable with every common colour blindness, and unlike the things on the maps.
COMMAND = "#000000"
EXECUTED = "#CC79A7"
COST = "#D55E00"
# half the side of a map in m at most: on a larger one, the path of a few decisions could not be
# seen
WIDEST = 4.0
FREE = 0.5  # share of the half side within which the robot may move before the map follows
# as shares of the half side: length of the arrow of a full action, and how far from the robot's
# middle it begins
REACH = 0.24
ROBOT = 0.05
_SMOOTH = 2


def stick(task: object, action: Floats) -> Floats | None:
    """Turn an action [A] into (forward, left) [2] in [-1, 1]; None if the task does not say how it
    is driven.

    A point is commanded by throttle and turn rate (left is positive). A car is commanded by the
    torques of its right and left wheel: their mean drives, and half of their difference turns left.
    """
    drive = getattr(task, "drive", None)
    if drive == "point":
        return np.array([action[0], action[1]])
    if drive == "car":
        return np.array([(action[0] + action[1]) / 2.0, (action[0] - action[1]) / 2.0])
    return None


def things_of(appearance: Appearance) -> tuple[tuple[str, str], ...]:
    """Return the names of what a map shows, the robot first, each with its colour `#rrggbb`.
    Colours of transparent things are mixed with white.
    """
    shown = [("robot", appearance.robot[0].colour, 1.0)] if appearance.robot else []
    shown += [(kind.name, kind.colour, kind.alpha) for kind in appearance.kinds]
    return tuple(
        (name, "#" + "".join(f"{round(255 * (alpha * c + 1 - alpha)):02x}" for c in colour))
        for name, colour, alpha in shown
    )


def legend_of(things: Sequence[tuple[str, str]]) -> tuple[tuple[str, str, str], ...]:
    """Return name, colour `#rrggbb` and meaning of everything on a map: its things (`things_of`),
    then the marks that are drawn on it.
    """
    meanings = {
        "robot": "with its path so far",
        "goal": "where it should go",
        "hazard": "being there costs",
        "vase": "an obstacle; in some tasks touching or moving it costs",
    }
    marks = (
        ("command", COMMAND, "arrow: what the operator commands"),
        ("executed", EXECUTED, "arrow: what was executed instead, where the assistant corrected"),
        ("cost", COST, "dots and edge: where it cost"),
    )
    return (*((name, colour, meanings.get(name, "")) for name, colour in things), *marks)


SEEN = (
    "The map is drawn for people. The assistant never sees it: it gets what the robot's own "
    "cameras see, here at the right."
)


def poses_of(appearance: Appearance, scene: Scene) -> Floats:
    """Return x, y and yaw of the robots' fronts, [B, 3]."""
    front = scene.rotation[:, :2, :2] @ np.array(appearance.forward)
    return np.concatenate([scene.position[:, :2], np.arctan2(front[:, 1], front[:, 0])[:, None]], 1)


class MapView:
    """The part of the world that a map shows during an episode. It stands still, or follows the
    robot.
    """

    def __init__(self, appearance: Appearance, size: int) -> None:
        self._appearance = appearance
        self._size = size
        self.half = min(appearance.map_half_side, WIDEST)
        whole = appearance.map_half_side <= WIDEST
        self._centre = np.array(appearance.map_centre or (0.0, 0.0)) if whole else None
        # A map that shows everything moves only if the robot would leave it.
        self._free = self.half * (0.9 if whole else FREE)

    def picture(self, scene: Scene) -> MapPicture:
        """Return the picture of the only row of a scene, to be drawn on."""
        at = scene.position[0, :2]
        centre = at if self._centre is None else self._centre
        self._centre = centre + (at - centre) - np.clip(at - centre, -self._free, self._free)
        return MapPicture.of(self._appearance, scene, self._size, self._centre, self.half)


class MapPicture:
    """A map, and marks at places of the world in m. Widths are in px of the finished image."""

    def __init__(self, image: Image.Image, centre: Floats, half: float) -> None:
        self._image = image
        self._centre = centre
        self._half = half
        self._draw = ImageDraw.Draw(image, "RGBA")

    @classmethod
    def of(
        cls, appearance: Appearance, scene: Scene, size: int, centre: Floats, half: float
    ) -> MapPicture:
        """Draw the only row of a scene as `size` px, `half` m from `centre` [2] to each side."""
        require_mujoco()
        from wasp_cli.tasks.camera.topdown import draw_map

        image = draw_map(
            appearance, scene, 0, size * _SMOOTH, ((float(centre[0]), float(centre[1])), half)
        )
        return cls(Image.fromarray(image), centre, half)

    def _pixels(self, places: Floats) -> list[tuple[float, float]]:
        scaled = (
            (np.asarray(places, np.float64).reshape(-1, 2) - self._centre)
            * np.array([1.0, -1.0])
            / self._half
        )
        return [(float(x), float(y)) for x, y in (scaled + 1.0) / 2.0 * self._image.width]

    def line(self, places: Floats, colour: str, width: float = 1.0, dash: int = 0) -> None:
        """Draw a line through places [N, 2] in m. With `dash`, every stretch after that many is
        left out.
        """
        points = self._pixels(places)
        thickness = round(width * _SMOOTH)
        if not dash:
            if len(points) > 1:
                self._draw.line(points, colour, thickness, joint="curve")
            return
        for index in range(len(points) - 1):
            if (index + 1) % (dash + 1):
                self._draw.line(points[index : index + 2], colour, thickness)

    def trail(self, places: Floats, width: float) -> None:
        """Draw where the robot has been [N, 2] in m: visible on light and dark ground."""
        self.line(places, "#FFFFFF90", 2.2 * width)
        self.line(places, "#404040C0", width)

    def dots(self, places: Floats, colour: str, radius: float, edge: str | None = None) -> None:
        """Draw a disc at each of N places [N, 2] in m."""
        reach = radius * _SMOOTH
        for x, y in self._pixels(places):
            self._draw.ellipse((x - reach, y - reach, x + reach, y + reach), colour, edge, _SMOOTH)

    def arrow(
        self, pose: Floats, push: Floats, colour: str, width: float, reach: float = REACH
    ) -> None:
        """Draw an action (forward, left) [2] at a robot (x, y, yaw) [3]: forward along its nose,
        left to its side.
        """
        cos = np.cos(pose[2])
        sin = np.sin(pose[2])
        pushed = reach * np.array([push[0] * cos - push[1] * sin, push[0] * sin + push[1] * cos])
        # The arrow begins beside the robot, so that it does not cover it.
        start = pose[:2] + ROBOT * self._half * pushed / max(float(np.hypot(*pushed)), 1e-9)
        (x0, y0), (x1, y1) = self._pixels(np.stack([start, start + self._half * pushed]))
        length = float(np.hypot(x1 - x0, y1 - y0))
        if length < _SMOOTH:
            return
        along = np.array([x1 - x0, y1 - y0]) / length
        side = np.array([-along[1], along[0]])
        # A white arrow that is a little larger, and the arrow itself on top.
        for grown, shade in ((1.0, "#FFFFFF"), (0.0, colour)):
            head = min(3.2 * width * _SMOOTH, 0.7 * length) + 2 * grown
            base = np.array([x1, y1]) - head * along
            corners = [
                np.array([x1, y1]) + 2 * grown * along,
                base + 0.6 * head * side,
                base - 0.6 * head * side,
            ]
            end = base + 0.3 * head * along
            self._draw.line(
                [(x0, y0), (float(end[0]), float(end[1]))],
                shade,
                round((width + 1.4 * grown) * _SMOOTH),
            )
            self._draw.polygon([(float(x), float(y)) for x, y in corners], shade)

    def edge(self, colour: str, width: float) -> None:
        """Draw a line around the picture."""
        side = self._image.width - 1
        self._draw.rectangle((0, 0, side, side), outline=colour, width=round(width * _SMOOTH))

    def finished(self) -> Image.Image:
        """Return the picture in its final size, with smooth edges."""
        return self._image.reduce(_SMOOTH)


def draw_actions(
    picture: MapPicture,
    task: object,
    pose: Floats,
    a_h: Floats,
    a: Floats,
    width: float,
    reach: float = REACH,
) -> None:
    """Draw the command [A] and, if it was changed, the action [A] as arrows. Nothing is drawn if
    the task does not say how it is driven (`stick`).
    """
    command = stick(task, a_h)
    executed = stick(task, a)
    if command is None or executed is None:
        return
    picture.arrow(pose, command, COMMAND, width, reach)
    if not np.array_equal(a_h, a):
        picture.arrow(pose, executed, EXECUTED, width, reach)


def cameras_of(pixels: Pixels) -> Pixels:
    """Turn what cameras see, one behind the other in the channels [3 * cameras, side, side],
    into images [cameras, side, side, 3].
    """
    return np.ascontiguousarray(np.moveaxis(pixels.reshape(-1, 3, *pixels.shape[1:]), 1, -1))


def along(places: Sequence[Floats]) -> Floats:
    """Return places as one array [N, 2]; [0, 2] without any."""
    return np.array(places, np.float64).reshape(-1, 2)


@lru_cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return the typeface of every picture, which comes with matplotlib: DejaVu Sans of `size`
    px.
    """
    folder = Path(load_matplotlib().get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(
        str(folder / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")), size
    )
