"""Pictures of vectors, for tasks that have neither a map nor cameras: the components over time, a
row for each. T = decisions so far, S = components.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from wasp_cli.tasks.base import Floats
from wasp_cli.video.map import COMMAND, COST, font

MOST = 10  # components that are drawn at most: the first ones that change
PAST = 60  # decisions that are drawn at most, the last ones
LABEL = 26  # px left of the curves for the number of a component
_INK = (20, 20, 20)
_GREY = (105, 105, 105)
_PAPER = (255, 255, 255)


@dataclass(frozen=True)
class Scale:
    """The components that are drawn, and the bounds of each."""

    components: tuple[int, ...]
    low: Floats  # [S]
    high: Floats  # [S]

    @classmethod
    def of(cls, states: Floats) -> Scale:
        """Take it from vectors [T, S]: the first components that change, each over its range."""
        low = states.min(0)
        high = states.max(0)
        moving = np.flatnonzero(high > low)[:MOST]
        components = moving if len(moving) else np.arange(min(MOST, len(low)))
        return cls(tuple(components.tolist()), low, high)

    def share(self, values: Floats, component: int) -> Floats:
        """Return where values [T] of a component lie between its bounds: 0 to 1, within them."""
        span = float(self.high[component] - self.low[component])
        if span <= 0.0:
            return np.full(len(values), 0.5)
        return np.asarray(np.clip((values - self.low[component]) / span, 0.0, 1.0))


@dataclass(frozen=True)
class Curves:
    """Vectors of consecutive decisions, and how they are drawn."""

    states: Floats  # [T, S]
    first: int  # the decision of the first one
    colour: str = COMMAND
    width: int = 2


def draw_curves(
    scale: Scale,
    curves: Sequence[Curves],
    span: tuple[int, int],
    size: tuple[int, int],
    *,
    costly: Sequence[int] = (),
    now: int | None = None,
) -> Image.Image:
    """Draw components over time.

    Args:
        scale: which components, and their bounds.
        curves: what is drawn, the last on top.
        span: first and last decision of the picture.
        size: of the picture, in px.
        costly: decisions that cost, which are marked.
        now: a decision that is marked by a line.
    """
    width, height = size
    image = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(image)
    begin, end = span
    across = (width - LABEL - 8) / max(1, end - begin)
    tall = height / len(scale.components)

    def x(decision: float) -> float:
        return LABEL + (decision - begin) * across

    for t in costly:
        if begin <= t <= end:
            draw.rectangle((x(t - 0.5), 0, x(t + 0.5), height), "#fbe4d5")
    if now is not None:
        draw.line((x(now), 0, x(now), height), _GREY, 1)
    for row, component in enumerate(scale.components):
        top = row * tall
        draw.text((4, top + tall / 2 - 6), str(component), _INK, font(10))
        draw.line((LABEL, top + tall - 1, width - 8, top + tall - 1), "#dddddd", 1)
        for curve in curves:
            share = scale.share(curve.states[:, component], component)
            y = top + 3 + (1.0 - share) * (tall - 7)
            times = curve.first + np.arange(len(share))
            shown = (times >= begin) & (times <= end)
            points = [(x(t), float(at)) for t, at in zip(times[shown], y[shown], strict=True)]
            if len(points) > 1:
                draw.line(points, curve.colour, curve.width)
            elif points:
                (px, py) = points[0]
                draw.ellipse((px - 2, py - 2, px + 2, py + 2), curve.colour)
    return image


def draw_course(scale: Scale, states: Floats, size: int, costly: Sequence[int] = ()) -> Image.Image:
    """Draw the last decisions of an episode so far, states [T, S], as a square of `size` px."""
    last = len(states) - 1
    span = (max(0, last - PAST + 1), max(last, PAST - 1))
    return draw_curves(scale, [Curves(states, 0)], span, (size, size), costly=costly)


def mark_cost(image: Image.Image, width: int) -> None:
    """Draw the edge of a picture in the colour of costs."""
    side = (image.width - 1, image.height - 1)
    ImageDraw.Draw(image).rectangle((0, 0, *side), outline=COST, width=width)
