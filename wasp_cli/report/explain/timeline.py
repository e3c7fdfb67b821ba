"""The timeline of an episode as SVG: what the method looked at, when it acted, and what cost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from wasp_cli.cells.table import Floats
from wasp_cli.metrics.episode import (
    GATE_LATE,
    GATE_METHOD,
    GATE_SAFETY,
    GATE_TASK,
)
from wasp_cli.report.explain.episode import Episode


class Look(NamedTuple):
    """How what a gate did is shown."""

    kind: str  # its name in rows and JSON, and its class on a page
    words: str
    colour: str  # of Okabe and Ito; `page/style.css` has it too, and a lighter one for dark pages
    style: str  # the nearest colour of a terminal


LOOKS = {  # by gate; if several fall together, the first one is shown
    GATE_SAFETY: Look("safety", "safety gate", "#0072B2", "bright_blue"),
    GATE_TASK: Look("task", "task gate", "#E69F00", "yellow"),
    GATE_METHOD: Look("method", "the method's own rule", "#009E73", "green"),
    GATE_LATE: Look("late", "late, the command stands", "#696969", "dim"),
}

CURVE = 36  # height of a curve in px
STRIP = 8  # of a row of marks
HEADROOM = 2.0  # thresholds up to which a curve is drawn; what is higher is cut off there
Span = tuple[str, int, int]  # kind of a mark, its first decision, and how many it covers
BASE = (("base", STRIP),)


class Lane(NamedTuple):
    """A row of a timeline, `height` px high; x counts decisions."""

    name: str
    height: int
    # horizontal lines: their class and height from above in px
    levels: Sequence[tuple[str, float | str]]
    curves: Sequence[str] = ()  # points of polylines, `x,y x,y ...`
    marks: Sequence[Span] = ()


def timeline(episode: Episode) -> list[Lane]:
    """Return the rows of an episode's timeline: what the method looked at, what it did, and what
    cost.
    """
    lanes = [_lane(*curve) for curve in curves(episode)]
    # Late decisions are shown too, although they changed nothing.
    acts = episode.intervened | (episode.gate == GATE_LATE)
    if acts.any():
        # A change without a gate is shown as the method's own rule.
        kinds = [
            LOOKS.get(gate, LOOKS[GATE_METHOD]).kind if is_shown else ""
            for gate, is_shown in zip(episode.gate.tolist(), acts, strict=True)
        ]
        lanes.append(Lane("acts", STRIP, BASE, marks=spans(kinds)))
    costs = spans(["cost" if is_costly else "" for is_costly in episode.costly])
    lanes.append(Lane("cost", STRIP, BASE, marks=costs))
    return lanes


class Curve(NamedTuple):
    """What a method looks at over an episode, and its threshold."""

    name: str
    values: Floats  # [T]
    limit: float | None
    limit_name: str


def curves(episode: Episode) -> list[Curve]:
    """Return the values that the method decides by. A method without a signal shows its deviation
    from the command, if it changed anything.
    """
    numbers = episode.numbers
    limits = episode.thresholds
    if episode.gated:
        return [
            Curve("Ḡᶜ", numbers["g_cost"], limits.tau_c, "τ_c"),
            Curve("ΔG", numbers["delta_g"], limits.tau_r, "τ_r"),
        ]
    if np.isfinite(numbers["signal"]).any():
        return [Curve(episode.signal.name, numbers["signal"], episode.signal_limit, "threshold")]
    if episode.intervened.any():
        return [Curve("|a−aᴴ|", numbers["deviation"], None, "")]
    return []


def spans(kinds: Iterable[str]) -> list[Span]:
    """Return the stretches of the same kind, in order; those of the empty kind are left out."""
    stretches: list[Span] = []
    at = 0
    for kind, group in groupby(kinds):
        length = len(list(group))
        if kind:
            stretches.append((kind, at, length))
        at += length
    return stretches


def _lane(name: str, values: Floats, limit: float | None, _: str) -> Lane:
    """A lane with a curve from the least value (or 0) to the greatest one, at most HEADROOM times
    the threshold. NaN is a gap.
    """
    defined = values[np.isfinite(values)]
    low = 0.0
    high = 0.0
    if len(defined):
        low = min(0.0, float(defined.min()))
        high = max(0.0, float(defined.max()))
    if limit is not None and limit > 0:
        low = max(low, -HEADROOM * limit)
        high = min(max(high, 1.1 * limit), HEADROOM * limit)
    span = high - low or 1.0

    def y(value: float) -> str:
        return f"{CURVE * (1.0 - (min(max(value, low), high) - low) / span):.4g}"

    levels = [("base", 0.0), *([("limit", limit)] if limit is not None else [])]
    # From the left to the right border of each decision, so that a single value shows as well.
    curves = [
        " ".join(
            f"{t},{y(float(values[t]))} {t + 1},{y(float(values[t]))}"
            for t in range(first, first + length)
        )
        for _, first, length in spans(["known" if known else "" for known in np.isfinite(values)])
    ]
    return Lane(name, CURVE, [(kind, y(level)) for kind, level in levels], curves)
