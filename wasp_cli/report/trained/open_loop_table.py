"""The diagnostics of a world model as a page for people."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Sets = Mapping[str, Mapping[str, Any]]
TITLES = {"held_out": "Held-out episodes of the dataset", "unseen": "Fresh episodes under operators that are not in the dataset"}
STEPS = (
    ("k", "k"), ("base rate", "base"), ("AUPRC", "auprc"), ("from", "auprc_low"), ("to", "auprc_high"),
    ("persistence", "persistence"), ("recall", "recall"),
    ("predicted / base", "predicted_over_base"), ("ECE", "calibration_error"), ("onset base", "onset_base"), ("onset AUPRC", "onset_auprc"),
    ("foreseen", "foreseen"), ("onset foreseen", "onset_foreseen"), ("reward R2", "reward_r2"),
    ("image error", "image_error"), ("copy error", "copy_error"), ("image / copy", "image_over_copy"),
)  # fmt: skip
"""Columns of the table per imagined step: title and key."""
WINDOW = (
    ("base rate", "base"), ("AUPRC", "auprc"), ("recall", "recall"), ("foreseen", "foreseen"), ("false alarms", "false_alarms"),
)  # fmt: skip


def open_loop_markdown(sets: Sets) -> str:
    """A section per set of episodes: steps 1..H, whole windows, the filtered state, what each cost source allows."""
    lines = ["# What the world model foresees", ""]
    for name, table in sets.items():
        steps, window, filtered = table["steps"], table["window"], table["filter"]
        lines += [f"## {TITLES.get(name, name)}", "", _episodes(table["episodes"], table["starts"], len(steps)), ""]
        lines += _table([title for title, _ in STEPS], [[_text(row[key]) for _, key in STEPS] for row in steps])
        rows = [[title, *(_text(window[f"{prefix}{key}"]) for _, key in WINDOW)] for title, prefix in (("all", ""), ("onset", "onset_"))]
        lines += ["", f"Any cost within {len(steps)} steps:", "", *_table(["starts", *(title for title, _ in WINDOW)], rows), ""]
        lines += [f"Persistence: AUPRC {_text(window['persistence'])}. Summed cost against the real sum: correlation"]
        lines += [f"{_text(window['cost_correlation'])}.", "", "The filtered state itself (k = 0): cost AUPRC"]
        lines += [f"{_text(filtered['auprc'])} at a base rate of {_text(filtered['base'])}, predicted / base"]
        lines += [f"{_text(filtered['predicted_over_base'])}, image error {_text(filtered['image_error'])} against"]
        lines += [f"{_text(filtered['image_variance'])} of the mean image.", ""]
        sources = list(steps[0]["foreseen_by_source"]) if steps else []
        if len(sources) > 1:
            rows = [[str(row["k"]), *(_text(row["foreseen_by_source"][kind]) for kind in sources)] for row in steps]
            lines += ["Share of the costs of each source that were foreseen:", "", *_table(["k", *sources], rows), ""]
        if any(row["ends_base"] > 0 for row in steps):
            rows = [[str(row["k"]), *(_text(row[f"ends_{key}"]) for key in ("base", "auprc", "over_base"))] for row in steps]
            lines += [
                "Episodes that end there by the task's own rule:",
                "",
                *_table(["k", "base rate", "AUPRC", "predicted / base"], rows),
                "",
            ]
    window = next(iter(sets.values()))["window"]
    lines += [
        "From and to are a 95 % interval of the AUPRC over resampled episodes. Persistence says that the cost stays what it is now,",
        "copy that the image does. Recall is at 10 % false alarms. Onset counts only starts that do not cost themselves. Foreseen is the",
        "share of the real costs before which the safety gate would have fired: the expected costly steps of the window, discounted by",
        f"{window['gamma']:g} a step, were above {window['threshold']:g}; false alarms is the share of windows without a cost in which",
        "they were too. ECE is the mean distance of predicted and seen over ten bins. Image errors are squared, per pixel, for values in",
        "[0, 1].",
    ]
    return "\n".join(lines) + "\n"


def _episodes(episodes: Mapping[str, int], starts: int, horizon: int) -> str:
    named = ", ".join(f"{name} {count}" for name, count in episodes.items())
    return f"{sum(episodes.values())} episodes ({named}), imagined {horizon} steps ahead from {starts} moments."


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_line(head), "|" + " ---: |" * len(head), *(_line(row) for row in rows)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return "-" if not math.isfinite(value) else f"{value:.4f}" if abs(value) < 0.1 else f"{value:.2f}"
