"""Films of the map, for which only the physics is played again, and the writing of animations: GIF,
APNG or WebP, with Pillow.

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
"""Number of colours in the palette that all frames share, so that a frame stores only its changes:
RARE ones cover the whole range of colours, COMMON ones are the most frequent. The colours in MEANT
are added as they are, since they have a meaning.
"""
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
# least distance (of 255) of a sampled colour from those in MEANT, so that none is used in their
# place
APART = 10
SAMPLES = 12  # frames from which the palette is made
_OPTIONS: dict[str, dict[str, Any]] = {
    "GIF": {"optimize": True, "disposal": 1},
    "PNG": {},
    "WEBP": {"quality": 50, "method": 2},
}


def checked(path: Path, still: Sequence[str] = ()) -> Path:
    """Return a path to which a video can be written, or a picture with an ending in `still`.

    Raises:
        UsageError: its ending is unknown, its folder does not exist, or it is a folder.
    """
    if path.suffix.lower() not in ENDINGS:
        hint = f"endings: {', '.join(ENDINGS)}"
        for ending in still:
            hint += f"; {ending} is a still"
        raise UsageError(f"'{path}': unsupported video format", hint)
    if not path.parent.is_dir():
        raise UsageError(
            f"'{path}': its folder does not exist", f"create the folder '{path.parent}'"
        )
    if path.is_dir():
        raise UsageError(f"'{path}' is a folder", "name a file")
    return path


def palette_of(frames: Sequence[Image.Image]) -> Image.Image:
    """Choose the colours that some frames need. Returns an image with a palette, for `quantize`."""
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
    """Write an animation, complete or not at all.

    Args:
        path: its ending says the format (ENDINGS).
        count: number of frames.
        frame: draws a frame by its number. Some frames are drawn twice, for the palette.
        milliseconds: how long each frame is shown.
        progress: gets the number of each frame.

    Raises:
        WaspError: the file cannot be written.
    """
    kind = ENDINGS[path.suffix.lower()]
    spread = np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).round().astype(int)).tolist()
    palette = None if kind == "WEBP" else palette_of([frame(index) for index in spread])

    def painted() -> Iterator[Image.Image]:
        for index in range(count):
            progress(index)
            image = frame(index)
            if palette is not None:
                image = image.quantize(palette=palette, dither=Image.Dither.NONE)
            yield image

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
        part.unlink(missing_ok=True)  # also after Ctrl-C
        if isinstance(error, OSError):
            raise refusal(error) from error
        raise


Array = NDArray[Any]

TOLERANCE = 1e-4  # of a reward, absolute and relative: smaller differences cannot be seen


class Moment(NamedTuple):
    """A frame of a film, with what it shows."""

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
    """Yield the frames of an episode: its map with trail, commands and costs. For a task without a
    map a frame is the picture that it draws of itself, or its front camera, or without cameras the
    components of its vector over time.

    A frame has an orange edge if there was a cost since the frame before. Arrows: see `map.stick`.

    Args:
        task: its name.
        action_repeat: env steps of a decision.
        layout_seed: of the episode's world.
        a: actions [T, A].
        a_h: commands [T, A].
        reward: recorded rewards [T], to check that this is the recorded episode.
        every: decisions from one frame to the next.
        size: side of a frame in px.
        cameras: whether moments have the camera images.

    Raises:
        ArtifactError: the actions do not fit the task, or lead to other rewards here.
    """
    # The task. Without a map it has to say what assistants see, which the frames show instead.
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
    paid: list[Floats] = []  # the positions at which it cost
    costly = False  # since the last frame
    for played in play(made, [layout_seed], [a], [reward], TOLERANCE):
        # What is kept of every decision.
        has_cost = bool(played.last is not None and played.last.cost[0])
        costly |= has_cost
        if course is not None:
            course.add(played, has_cost)
        scene = made.scene(np.array([0])) if isinstance(made, HasScene) else None
        if scene is not None:
            positions.append(scene.position[0, :2].copy())
            if has_cost:
                paid.append(positions[-1])
        if played.t % every and played.t < len(a):
            continue

        # A frame.
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
    """The vector of an episode so far. What comes later is not known, so the bounds of a component
    grow during the film.
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
