"""The gate timeline of an episode: what each gate saw against its threshold, what was done, what it cost.

One unit of width is one decision, so that a cursor can be set to any of them.
"""

from __future__ import annotations

from itertools import groupby

import numpy as np

from wasp_cli.metrics.episode import GATE_METHOD, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.stored import Episode, Floats, signal_of
from wasp_cli.report.page.markup import Markup, element

CURVE, STRIP = 36, 8
"""Heights in px of a curve and of a row of marks."""
KINDS = {GATE_SAFETY: "safety", GATE_TASK: "task", GATE_METHOD: "method"}
HEADROOM = 2.0
"""Thresholds up to which a curve is drawn; what is higher is cut off there."""
Span = tuple[str, int, int]
"""Kind of a mark, its first decision, and how many it covers."""


def timeline(episode: Episode) -> Markup:
    """A row for each gate's curve, with its threshold dashed, one for the interventions and one for the costs.

    The lines of class `cursor` mark a decision.
    """
    rows = [_lane(name, _curve(values, limit, episode.decisions), CURVE, episode) for name, values, limit in _curves(episode)]
    if episode.intervened.any():
        kinds = [KINDS.get(gate, "method") if here else "" for gate, here in zip(episode.gate.tolist(), episode.intervened, strict=True)]
        rows.append(_lane("acts", _marks(_spans(kinds), episode.decisions), STRIP, episode))
    rows.append(_lane("cost", _marks(_spans(["cost" if here else "" for here in episode.costly]), episode.decisions), STRIP, episode))
    return element("div", *rows, class_="timeline")


def _lane(name: str, parts: list[Markup], height: int, episode: Episode) -> Markup:
    cursor = element("line", class_="cursor", x1=0.5, x2=0.5, y1=0, y2=height)
    drawing = element(
        "svg", *parts, cursor, viewBox=f"0 0 {episode.decisions} {height}", height=height, preserveAspectRatio="none", role="img",
        aria_label=f"{name} over {episode.decisions} decisions",
    )  # fmt: skip
    return element("div", element("span", name), drawing, class_="lane")


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


def _marks(spans: list[Span], decisions: int) -> list[Markup]:
    base = element("line", class_="base", x1=0, x2=decisions, y1=STRIP, y2=STRIP)
    return [base, *(element("rect", class_=kind, x=first, y=0, width=length, height=STRIP) for kind, first, length in spans)]


def _curve(values: Floats, limit: float | None, decisions: int) -> list[Markup]:
    """From 0, or the least value, to the greatest one, at most a multiple of the threshold."""
    defined = values[np.isfinite(values)]
    low, high = (min(0.0, float(defined.min())), max(0.0, float(defined.max()))) if len(defined) else (0.0, 0.0)
    if limit is not None and limit > 0:
        low, high = max(low, -HEADROOM * limit), min(max(high, 1.1 * limit), HEADROOM * limit)
    span = high - low or 1.0

    def y(value: float) -> str:
        return f"{CURVE * (1.0 - (min(max(value, low), high) - low) / span):.4g}"

    levels = [("base", 0.0), *([("limit", limit)] if limit is not None else [])]
    parts = [element("line", class_=kind, x1=0, x2=decisions, y1=y(level), y2=y(level)) for kind, level in levels]
    for _, first, length in _spans(["known" if known else "" for known in np.isfinite(values)]):
        # From the left to the right border of each decision, so that a single value shows as well.
        points = " ".join(f"{t},{y(float(values[t]))} {t + 1},{y(float(values[t]))}" for t in range(first, first + length))
        parts.append(element("polyline", class_="curve", points=points))
    return parts
