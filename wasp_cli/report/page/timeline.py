"""The gate timeline of an episode: what each gate saw against its threshold, what was done, what it cost.

One unit of width is one decision, so that a cursor can be set to any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from wasp_cli.metrics.episode import GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.stored import Episode, Floats, signal_of

CURVE, STRIP = 36, 8
"""Heights in px of a curve and of a row of marks."""
KINDS = {GATE_SAFETY: "safety", GATE_TASK: "task", GATE_METHOD: "method"}
HEADROOM = 2.0
"""Thresholds up to which a curve is drawn; what is higher is cut off there."""
Span = tuple[str, int, int]
"""Kind of a mark, its first decision, and how many it covers."""
BASE = (("base", STRIP),)


class Lane(NamedTuple):
    """A row of a timeline, `height` px high; x counts decisions."""

    name: str
    height: int
    levels: Sequence[tuple[str, float | str]]
    """Horizontal lines: their class and height from above in px."""
    curves: Sequence[str] = ()
    """Points of polylines, `x,y x,y ...`."""
    marks: Sequence[Span] = ()


def timeline(episode: Episode) -> list[Lane]:
    """Return a row for each gate's curve, with its threshold, one for the interventions and one for the costs."""
    lanes = [_curve(name, values, limit) for name, values, limit in _curves(episode)]
    if episode.intervened.any():
        kinds = [KINDS.get(gate, "method") if here else "" for gate, here in zip(episode.gate.tolist(), episode.intervened, strict=True)]
        lanes.append(Lane("acts", STRIP, BASE, marks=_spans(kinds)))
    return [*lanes, Lane("cost", STRIP, BASE, marks=_spans(["cost" if here else "" for here in episode.costly]))]


def _curves(episode: Episode) -> list[tuple[str, Floats, float | None]]:
    """Name, values [T] and threshold of what the method looks at; a method without a signal of its own shows its deviation."""
    numbers, limits = episode.numbers, episode.thresholds
    if episode.gated:
        return [("Ḡᶜ", numbers["g_cost"], limits.tau_c), ("ΔG", numbers["delta_g"], limits.tau_r)]
    if np.isfinite(numbers["signal"]).any():
        return [(signal_of(str(episode.row["method"])).name, numbers["signal"], episode.signal_limit)]
    return [("|a−aᴴ|", numbers["deviation"], None)] if episode.intervened.any() else []


def _spans(kinds: list[str]) -> list[Span]:
    """The stretches of one kind; an empty kind is none."""
    spans: list[Span] = []
    at = 0
    for kind, group in groupby(kinds):
        length = len(list(group))
        if kind:
            spans.append((kind, at, length))
        at += length
    return spans


def _curve(name: str, values: Floats, limit: float | None) -> Lane:
    """Draw from 0, or the least value, to the greatest one, at most a multiple of the threshold; NaN is a gap."""
    defined = values[np.isfinite(values)]
    low, high = (min(0.0, float(defined.min())), max(0.0, float(defined.max()))) if len(defined) else (0.0, 0.0)
    if limit is not None and limit > 0:
        low, high = max(low, -HEADROOM * limit), min(max(high, 1.1 * limit), HEADROOM * limit)
    span = high - low or 1.0

    def y(value: float) -> str:
        return f"{CURVE * (1.0 - (min(max(value, low), high) - low) / span):.4g}"

    levels = [("base", 0.0), *([("limit", limit)] if limit is not None else [])]
    # From the left to the right border of each decision, so that a single value shows as well.
    curves = [
        " ".join(f"{t},{y(float(values[t]))} {t + 1},{y(float(values[t]))}" for t in range(first, first + length))
        for _, first, length in _spans(["known" if known else "" for known in np.isfinite(values)])
    ]
    return Lane(name, CURVE, [(kind, y(level)) for kind, level in levels], curves)
