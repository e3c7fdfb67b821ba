"""Frames as an animation: GIF, APNG or WebP, with Pillow alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageColor, features

from wasp_cli.errors import UsageError, refusal
from wasp_cli.report.explain.timeline import LOOKS
from wasp_cli.video.map import COMMAND, COST, EXECUTED

ENDINGS = {".gif": "GIF", ".png": "PNG", ".apng": "PNG", ".webp": "WEBP"}  # formats by file ending
STILL = (".png",)  # endings of a still picture, where there may be one: an animated PNG is then called .apng
RARE, COMMON = 24, 72
"""Colours of the palette that all frames share (then a frame stores only what has changed): some that cover all that is seen, more for
what there is most of. Beside them are those that mean something, which must not become others."""
MEANT = (
    COMMAND, EXECUTED, COST, *(look.colour for look in LOOKS.values()), "#FFFFFF", "#F0D2E4", "#8F3F74", "#A0A0A0", "#D0D0D0", "#F2F2F2",
)  # fmt: skip
APART = 10
"""By how much of 255 a sampled colour differs from those at least; a nearer one would be taken in their place."""
SAMPLES = 12  # frames from which the palette is made
_OPTIONS: dict[str, dict[str, Any]] = {
    "GIF": {"optimize": True, "disposal": 1},
    "PNG": {},
    "WEBP": {"quality": 50, "method": 2},
}


def checked(path: Path, still: Sequence[str] = ()) -> Path:
    """Return the path if a video, or a picture with an ending of `still`, can be written there, else raise a UsageError."""
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(
            f"'{path}': unsupported video format", f"endings: {', '.join(ENDINGS)}" + "".join(f"; {one} is a still" for one in still)
        )
    if not path.parent.is_dir():
        raise UsageError(f"'{path}': its folder does not exist", f"create the folder '{path.parent}'")
    if path.is_dir():
        raise UsageError(f"'{path}' is a folder", "name a file")
    if path.suffix.lower() == ".webp" and not features.check("webp"):
        raise UsageError("this Pillow was built without WebP", "use .gif or .png")
    return path


def palette_of(frames: Sequence[Image.Image]) -> Image.Image:
    """Choose the colours that some frames need, as an image with a palette."""
    sheet = Image.fromarray(np.concatenate([np.asarray(frame.reduce(2)) for frame in frames]))
    colours: list[tuple[int, ...]] = [ImageColor.getrgb(colour)[:3] for colour in MEANT]
    for method, count in ((Image.Quantize.MAXCOVERAGE, RARE), (Image.Quantize.MEDIANCUT, COMMON)):
        flat = sheet.quantize(count, method, dither=Image.Dither.NONE).getpalette("RGB") or []
        found = [tuple(flat[first : first + 3]) for first in range(0, len(flat), 3)]
        colours += [one for one in found if all(np.abs(np.subtract(one, meant)).max() > APART for meant in colours[: len(MEANT)])]
    palette = Image.new("P", (1, 1))
    palette.putpalette([part for colour in dict.fromkeys(colours) for part in colour])
    return palette


def write(
    path: Path, count: int, frame: Callable[[int], Image.Image], milliseconds: Sequence[int], progress: Callable[[int], None]
) -> None:
    """Write an animation of `count` frames, complete or not at all; some frames are painted twice."""
    kind = ENDINGS[path.suffix.lower()]
    spread = np.unique(np.linspace(0, count - 1, min(SAMPLES, count)).round().astype(int)).tolist()
    palette = None if kind == "WEBP" else palette_of([frame(index) for index in spread])

    def painted() -> Iterator[Image.Image]:
        for index in range(count):
            progress(index)
            image = frame(index)
            yield image if palette is None else image.quantize(palette=palette, dither=Image.Dither.NONE)

    whole = painted()
    first = next(whole)
    part = path.with_name(path.name + ".part")
    try:
        first.save(part, format=kind, save_all=True, append_images=list(whole), duration=list(milliseconds), loop=0, **_OPTIONS[kind])
        part.replace(path)
    except BaseException as error:
        part.unlink(missing_ok=True)  # also of one that was interrupted
        if isinstance(error, OSError):
            raise refusal(error) from error
        raise
