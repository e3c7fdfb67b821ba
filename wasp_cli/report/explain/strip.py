"""An episode as a strip of characters: the safety gate's value over time, the gates below it, the costs below them."""

from __future__ import annotations

import math
import textwrap
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from wasp_cli.metrics.episode import GATE_METHOD, GATE_NONE, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import Story, exceeds

BLOCKS = "▁▂▃▄▅▆▇█"
LABEL = 12
SILENT = ("·", "dim", "")
LETTERS = {GATE_SAFETY: ("S", "yellow", "safety"), GATE_TASK: ("T", "cyan", "task"), GATE_METHOD: ("M", "magenta", "the method's own")}


def strip_lines(story: Story, width: int) -> list[Text]:
    """Four lines and a legend; none where there is nothing to draw (no gate's value, no intervention)."""
    value, full, name = _measure(story)
    if not full:
        return []
    per = max(1, math.ceil(len(value) / max(20, width - LABEL - 2)))
    groups = [slice(start, start + per) for start in range(0, len(value), per)]
    limit = story.thresholds.tau_c if name == "G^c" else None
    curve: list[tuple[str, str]] = []  # a character and its style per column
    gates, costs = curve.copy(), curve.copy()
    missed = set(story.totals.missed)
    for part in groups:
        height = _greatest(value[part])
        curve.append((_block(height, full), "" if limit is None else "red" if exceeds(height, limit) else "green"))
        gates.append(LETTERS.get(_strongest(story.series["gate"][part]), SILENT)[:2])
        paid = [t for t in range(part.start, min(part.stop, len(value))) if story.series["cost_env"][t] > 0]
        costs.append(("!" if missed.intersection(paid) else "x", "bold red") if paid else SILENT[:2])
    seen = {gate for gate in LETTERS if (story.series["gate"] == gate).any() and story.selective}
    last = str(len(value) - 1)
    axis = Text(_label("decision") + "0" + last.rjust(max(len(groups) - 1, len(last) + 1)), "dim")
    lines = [_line(name, curve)]
    if seen:
        lines.append(_line("gate", gates))
    if story.totals.costly:
        lines.append(_line("cost", costs))
    lines.append(axis)
    legend = textwrap.wrap("; ".join(_legend(story, seen, limit, full, per)), width, initial_indent="  ", subsequent_indent="  ")
    return [*lines, *(Text(line, "dim") for line in legend)]


def _measure(story: Story) -> tuple[NDArray[np.float64], float, str]:
    """What is drawn [T], the value of a full block, and its name."""
    cost, size = story.series["g_cost"], story.series["deviation"]
    limit = story.thresholds.tau_c
    if story.gated and np.isfinite(cost).any():
        # Half of the height is the threshold: what stands above the middle has fired, without any colour.
        return cost, 2 * float(np.float32(limit)) if limit is not None and limit > 0 else float(np.nanmax(cost)), "G^c"
    return size, float(size.max()), "|a - a^H|"


def _legend(story: Story, seen: set[int], limit: float | None, full: float, per: int) -> list[str]:
    parts = [f"█ is {full:.3g}" if limit is None else f"▁▂▃▄ up to τ_c = {limit:.3g}, ▅▆▇█ above it"]
    parts += [f"{LETTERS[gate][0]} {LETTERS[gate][2]}" for gate in LETTERS if gate in seen]
    if story.totals.costly:
        parts.append("x cost" if not story.totals.missed else "x cost, ! cost that every gate missed")
    return [*parts, f"a column is {per} decisions, at their greatest"] if per > 1 else parts


def _block(height: float, full: float) -> str:
    """A value up to half of `full` is in the lower four blocks, the half itself too."""
    if math.isnan(height):
        return " "
    return BLOCKS[min(max(math.ceil(8 * height / full) - 1, 0), 7)] if full > 0 else BLOCKS[0]


def _greatest(values: NDArray[np.float64]) -> float:
    defined = values[np.isfinite(values)]
    return float(defined.max()) if len(defined) else math.nan


def _strongest(gates: NDArray[np.int64]) -> int:
    """Safety before task before another rule before none."""
    return next((gate for gate in LETTERS if (gates == gate).any()), GATE_NONE)


def _line(name: str, marks: list[tuple[str, str]]) -> Text:
    """Marks of one style in a row are one piece: a terminal gets a third of the bytes."""
    line = Text(_label(name))
    for style, group in groupby(marks, key=lambda mark: mark[1]):
        line.append("".join(character for character, _ in group), style)
    return line


def _label(name: str) -> str:
    return "  " + name.ljust(LABEL - 2)
