"""Films of the map from the physics alone, and how frames become an animation: GIF, APNG or WebP,
with Pillow alone.

T = decisions of the episode, A = action size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from wasp_cli.errors import ArtifactError, UsageError, refusal
from wasp_cli.learning.playback import Played, play
from wasp_cli.report.explain.timeline import LOOKS
from wasp_cli.tasks.base import Floats, Pixels
from wasp_cli.tasks.camera.appearance import HasScene
from wasp_cli.tasks.make import make_task
from wasp_cli.tasks.pictures import picture_of
from wasp_cli.tasks.sight import seen_of
from wasp_cli.video.map import (
    COMMAND,
    COST,
    EXECUTED,
    MapView,
    along,
    cameras_of,
    draw_actions,
    poses_of,
    things_of,
)
from wasp_cli.video.picture import asking_for_pictures, fitted
from wasp_cli.video.vectors import Scale, draw_course, mark_cost

ENDINGS = {".gif": "GIF", ".png": "PNG", ".apng": "PNG", ".webp": "WEBP"}  # formats by file ending
# endings of a still picture, where there may be one: an animated PNG is then called .apng
STILL = (".png",)
RARE = 24
COMMON = 72
"""Colours of the palette that all frames share (then a frame stores only what has changed): some
that cover all that is seen, more for what there is most of. Beside them are those that mean
something, which must not become others."""
MEANT = (
    COMMAND,
    EXECUTED,
    COST,
    *(look.colour for look in LOOKS.values()),
    "#FFFFFF",
    "#F0D2E4",
    "#8F3F74",
    "#A0A0A0",
    "#D0D0D0",
    "#F2F2F2",
)
# by how much of 255 a sampled colour differs from those at least; a nearer one would be taken in
# their place
APART = 10
SAMPLES = 12  # frames from which the palette is made
_OPTIONS: dict[str, dict[str, Any]] = {
    "GIF": {"optimize": True, "disposal": 1},
    "PNG": {},
    "WEBP": {"quality": 50, "method": 2},
}


def checked(path: Path, still: Sequence[str] = ()) -> Path:
    """Return the path if a video, or a picture with an ending of `still`, can be written there,
    else raise a UsageError.
    """
    if path.suffix.lower() not in ENDINGS:
        hint = f"endings: {', '.join(ENDINGS)}" + "".join(f"; {one} is a still" for one in still)
        raise UsageError(f"'{path}': unsupported video format", hint)
    if not path.parent.is_dir():
        raise UsageError(
            f"'{path}': its folder does not exist", f"create the folder '{path.parent}'"
        )
    if path.is_dir():
        raise UsageError(f"'{path}' is a folder", "name a file")
    return path


def palette_of(frames: Sequence[Image.Image]) -> Image.Image:
    """Choose the colours that some frames need, as an image with a palette."""
    sheet = Image.fromarray(np.concatenate([np.asarray(frame.reduce(2)) for frame in frames]))
    colours: list[tuple[int, ...]] = [ImageColor.getrgb(colour)[:3] for colour in MEANT]
    for method, count in ((Image.Quantize.MAXCOVERAGE, RARE), (Image.Quantize.MEDIANCUT, COMMON)):
        flat = sheet.quantize(count, method, dither=Image.Dither.NONE).getpalette("RGB") or []
        sampled = [tuple(flat[first : first + 3]) for first in range(0, len(flat), 3)]
        colours += [
            one
            for one in sampled
            if all(np.abs(np.subtract(one, meant)).max() > APART for meant in colours[: len(MEANT)])
        ]
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in dict.fromkeys(colours) for part in colour])
    return palette


def write(
    path: Path,
    count: int,
    frame: Callable[[int], Image.Image],
    milliseconds: Sequence[int],
    progress: Callable[[int], None],
) -> None:
    """Write an animation of `count` frames, complete or not at all; some frames are painted
    twice.
    """
    kind = ENDINGS[path.suffix.lower()]
    spread = np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).round().astype(int)).tolist()
    palette = None if kind == "WEBP" else palette_of([frame(index) for index in spread])

    def painted() -> Iterator[Image.Image]:
        for index in range(count):
            progress(index)
            image = frame(index)
            yield (
                image
                if palette is None
                else image.quantize(palette=palette, dither=Image.Dither.NONE)
            )

    whole = painted()
    first = next(whole)
    part = path.with_name(path.name + ".part")
    try:
        first.save(
            part,
            format=kind,
            save_all=True,
            append_images=list(whole),
            duration=list(milliseconds),
            loop=0,
            **_OPTIONS[kind],
        )
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)  # also of one that was interrupted
        if isinstance(error, OSError):
            raise refusal(error) from error
        raise


Array = NDArray[Any]

TOLERANCE = 1e-4  # of a reward, absolute and relative: a film that differs by less shows the same


class Moment(NamedTuple):
    frame: Pixels  # uint8 [size, size, 3]
    decision: int  # how many decisions had been made: 0, every, 2 every, ..., T
    # [N, 2] of the robot in m before each decision so far; nothing of a task that does not say
    # where it is
    positions: Floats
    # what its map shows, see `map.things_of`; nothing of a task without a map
    things: tuple[tuple[str, str], ...]
    # [cameras, side, side, 3] what the robot's cameras see, where that was asked for
    seen: Pixels | None


def film(
    task: str,
    action_repeat: int,
    layout_seed: int,
    a: Array,
    a_h: Array,
    reward: Array,
    every: int,
    size: int,
    *,
    cameras: bool = False,
) -> Iterator[Moment]:
    """Draw the map of an episode with trail, commands and costs; of a task without a map, what it
    draws of itself, or else what its front camera sees, or without cameras the components of its
    vector over time.

    A frame of `size` px has an orange edge when cost was paid since the frame before, `every`
    decisions ago. Arrows: see `map.stick`. An ArtifactError where the episode of actions a [T, A],
    commands a_h [T, A] and rewards [T] is not what happens here.
    """
    sight = seen_of(task)
    shown = (sight,) if cameras and sight == "pixels" else ()
    made = make_task(task, 1, action_repeat=action_repeat, observe=shown)
    if not isinstance(made, HasScene):
        seeing = (sight, *asking_for_pictures(task))
        made = make_task(task, 1, action_repeat=action_repeat, observe=seeing)
    for actions in (a, a_h):
        if actions.shape != (len(reward), made.action_size) or not np.isfinite(actions).all():
            raise ArtifactError(
                f"the rows do not have {made.action_size} finite numbers for every action",
                "run the spec again",
            )
    view = MapView(made.appearance(), size) if isinstance(made, HasScene) else None
    course = _Course(size) if view is None and sight == "state" else None
    things = things_of(made.appearance()) if isinstance(made, HasScene) else ()
    positions: list[Floats] = []
    paid: list[Floats] = []
    costly = False
    for played in play(made, [layout_seed], [a], [reward], TOLERANCE):
        now = bool(played.last is not None and played.last.cost[0])
        costly |= now
        if course is not None:
            course.add(played, now)
        scene = made.scene(np.array([0])) if isinstance(made, HasScene) else None
        if scene is not None:
            positions.append(scene.position[0, :2].copy())
            paid += [positions[-1]] if now else []
        if played.t % every and played.t < len(a):
            continue
        drawn = picture_of(made)
        if drawn is not None:
            square = fitted(drawn, size)
            if costly:
                mark_cost(square, max(1, size // 50))
            frame = np.asarray(square)
        elif isinstance(made, HasScene) and view is not None and scene is not None:
            picture = view.picture(scene)
            picture.trail(along(positions), size / 160)
            picture.dots(along(paid), COST, size / 90)
            if played.t < len(a):
                draw_actions(
                    picture,
                    made,
                    poses_of(made.appearance(), scene)[0],
                    a_h[played.t],
                    a[played.t],
                    size / 70,
                )
            if costly:
                picture.edge(COST, size / 50)
            frame = np.asarray(picture.finished())
        elif course is not None:
            frame = np.asarray(course.picture(costly))
        else:
            image = Image.fromarray(_seen(played)[0]).resize((size, size), Image.Resampling.NEAREST)
            if costly:
                mark_cost(image, max(1, size // 50))
            frame = np.asarray(image)
        seen = _seen(played) if cameras and sight == "pixels" else None
        yield Moment(frame, played.t, along(positions), things, seen)
        costly = False


class _Course:
    """The vector of an episode so far. What has not come yet is not known, so that the bounds of a
    component grow while it is drawn.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._states: list[Floats] = []
        self._costly: list[int] = []

    def add(self, played: Played, cost: bool) -> None:
        """Add the vector after a decision, and whether it cost."""
        assert played.observation.state is not None
        self._states.append(played.observation.state[0].copy())
        if cost:
            self._costly.append(played.t)

    def picture(self, costly: bool) -> Image.Image:
        """Draw the components over time, with a mark where the last decision cost."""
        states = np.array(self._states)
        image = draw_course(Scale.of(states), states, self._size, self._costly)
        if costly:
            mark_cost(image, max(1, self._size // 50))
        return image


def _seen(played: Played) -> Pixels:
    assert played.observation.pixels is not None
    return cameras_of(played.observation.pixels[0])
