"""Pages of trained parts in Markdown: what a dataset holds, what is foreseen of it, what a denoiser does."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wasp_cli.report.render.text import markdown_row
from wasp_cli.report.trained.artifacts import UNREADABLE, Trained, read_json
from wasp_cli.store.artifact import replace_file
from wasp_cli.store.layout import Layout

ALL = "all"
"""The row of a dataset's contents that has all behaviours."""
COSTLY_SHARE = (0.03, 0.15)
"""Share of costly decision steps that a dataset should have: with less a model learns no cost, with more nothing of driving well."""

SETS = {"held_out": "Held-out episodes of the dataset", "unseen": "Fresh episodes under operators that are not in the dataset"}
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

Document = Mapping[str, Any]


# -- datasets ---------------------------------------------------------------------------------------------------


def dataset_warnings(contents: Document) -> list[str]:
    """Say what is wrong with a dataset; a task without cost sources has nothing to warn of."""
    sources, share = contents[ALL]["sources"], contents[ALL]["costly_share"]
    if not sources:
        return []
    found = [f"no step costs by {kind}" for kind, part in sources.items() if part == 0.0]
    low, high = COSTLY_SHARE
    if not low <= share <= high:
        found.append(f"{share:.1%} of the steps cost, not {low:.0%} to {high:.0%}")
    return found


def with_warnings(layout: Layout, trained: Iterable[Trained]) -> tuple[Trained, ...]:
    """Add to the summary of every dataset what is wrong with it, as `warning`."""

    def judged(artifact: Trained) -> Trained:
        if artifact.kind != "dataset" or "warning" in artifact.summary:
            return artifact
        try:
            found = dataset_warnings(read_json(layout, artifact, "contents.json"))
        except UNREADABLE:
            return artifact
        return replace(artifact, summary={**artifact.summary, "warning": "; ".join(found)}) if found else artifact

    return tuple(map(judged, trained))


def contents_markdown(contents: Document) -> str:
    """Lay out what a dataset holds: a row per behaviour, the whole first; shares in percent."""
    sources = list(contents[ALL]["sources"])
    head = ["behaviour", "episodes", "steps", "return", "goals", "with a goal", "ended by rule", "cost", "costly steps", *sources]
    rows = [
        [
            name, f"{row['episodes']} ({row['share']:.0%})", row["steps"], f"{row['return_per_episode']:.2f}",
            f"{row['goals_per_episode']:.2f}", f"{row['with_goal']:.0%}", f"{row['terminal']:.0%}", f"{row['cost_per_episode']:.1f}",
            *(f"{share:.2%}" for share in (row["costly_share"], *(row["sources"][kind] for kind in sources))),
        ]
        for name, row in contents.items()
    ]  # fmt: skip
    lines = ["# What the dataset holds", "", *_table(head, rows), ""]
    lines += ["Return, goals and cost (env steps that cost) are means per episode; costly steps and the cost sources are shares of the"]
    lines += ["decision steps, and one step may cost by several sources."]
    warnings = dataset_warnings(contents)
    lines += ["", *(f"Warning: {text}." for text in warnings)] if warnings else []
    return "\n".join(lines) + "\n"


# -- diagnostics of a world model -------------------------------------------------------------------------------


def open_loop_markdown(sets: Document) -> str:
    """Lay out a section per set of episodes: steps 1..H, whole windows, the filtered state, what each cost source allows."""
    lines = ["# What the world model foresees", ""]
    for name, table in sets.items():
        steps, window, filtered = table["steps"], table["window"], table["filter"]
        named = ", ".join(f"{behaviour} {count}" for behaviour, count in table["episodes"].items())
        total, moments = sum(table["episodes"].values()), f"imagined {len(steps)} steps ahead from {table['starts']} moments"
        lines += [f"## {SETS.get(name, name)}", "", f"{total} episodes ({named}), {moments}.", ""]
        lines += _table([title for title, _ in STEPS], [[_short(row[key]) for _, key in STEPS] for row in steps], numbers=True)
        rows = [[title, *(_short(window[f"{prefix}{key}"]) for _, key in WINDOW)] for title, prefix in (("all", ""), ("onset", "onset_"))]
        head = ["starts", *(title for title, _ in WINDOW)]
        lines += ["", f"Any cost within {len(steps)} steps:", "", *_table(head, rows, numbers=True), ""]
        lines += [f"Persistence: AUPRC {_short(window['persistence'])}. Summed cost against the real sum: correlation"]
        lines += [f"{_short(window['cost_correlation'])}.", "", "The filtered state itself (k = 0): cost AUPRC"]
        lines += [f"{_short(filtered['auprc'])} at a base rate of {_short(filtered['base'])}, predicted / base"]
        lines += [f"{_short(filtered['predicted_over_base'])}, image error {_short(filtered['image_error'])} against"]
        lines += [f"{_short(filtered['image_variance'])} of the mean image.", ""]
        lines += _readout(table.get("readout"))
        sources = list(steps[0]["foreseen_by_source"]) if steps else []
        if len(sources) > 1:
            rows = [[str(row["k"]), *(_short(row["foreseen_by_source"][kind]) for kind in sources)] for row in steps]
            lines += ["Share of the costs of each source that were foreseen:", "", *_table(["k", *sources], rows, numbers=True), ""]
        if any((row["ends_base"] or 0) > 0 for row in steps):
            rows = [[str(row["k"]), *(_short(row[f"ends_{key}"]) for key in ("base", "auprc", "over_base"))] for row in steps]
            head = ["k", "base rate", "AUPRC", "predicted / base"]
            lines += ["Episodes that end there by the task's own rule:", "", *_table(head, rows, numbers=True), ""]
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


def _readout(told: Document | None) -> list[str]:
    """What the privileged vector has in the model: a row per place that it is read from. Older diagnostics have none."""
    if not told:
        return []
    places = (("filtered latent", "filtered"), ("embedding of the image", "embedding"), (f"imagined, step {told['step']}", "imagined"))
    groups = list(told["filtered"])
    rows = [[title, *(_short(told[place][group]) for group in groups)] for title, place in places]
    head = "What a ridge regression tells of the privileged vector, as R2 (fitted on the episodes that were learned from):"
    return [head, "", *_table(["read from", *groups], rows), ""]


# -- denoisers --------------------------------------------------------------------------------------------------


def quality_markdown(quality: Document) -> str:
    """Lay out the distances of denoised commands: a row for each kind of command and ratio."""
    rows = [
        [kind, ratio, _three(row["conformity"]), _three(row["fidelity"])]
        for kind, by_ratio in quality.items()
        for ratio, row in by_ratio.items()
    ]
    return "\n".join(_table(["command", "ratio", "to the expert's action", "to the command"], rows)) + "\n"


# -- files ------------------------------------------------------------------------------------------------------


def write_contents(layout: Layout, artifact: Trained, path: Path) -> None:
    """Write what a dataset holds."""
    replace_file(path, contents_markdown(read_json(layout, artifact, "contents.json")))


def write_open_loop(layout: Layout, artifact: Trained, path: Path) -> None:
    """Write what a world model foresees."""
    replace_file(path, open_loop_markdown(read_json(layout, artifact, "diagnostics.json")))


def write_quality(layout: Layout, artifact: Trained, path: Path) -> None:
    """Write what a denoiser does."""
    replace_file(path, quality_markdown(read_json(layout, artifact, "quality.json")))


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]], *, numbers: bool = False) -> list[str]:
    """A Markdown table; its first column is of words, unless all are of numbers."""
    rule = "|" + " ---: |" * len(head) if numbers else "| --- |" + " ---: |" * (len(head) - 1)
    return [markdown_row(head), rule, *map(markdown_row, rows)]


def _short(value: Any) -> str:
    """A number with as many places as its size asks for."""
    if isinstance(value, int):
        return str(value)
    return "-" if value is None or not math.isfinite(value) else f"{value:.4f}" if abs(value) < 0.1 else f"{value:.2f}"


def _three(value: Any) -> str:
    """A number with three places."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.3f}"
