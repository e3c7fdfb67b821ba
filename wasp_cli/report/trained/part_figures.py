"""Figures of single trained parts: how one learned, and how far what it predicts comes true."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wasp_cli.report.figures.style import GREY, PALETTE, Line, draw_lines, drawn, save_png
from wasp_cli.report.trained.artifacts import Trained, column_of, config_of, read_json, read_table, rows_of
from wasp_cli.report.trained.figures import STEPS
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUANTITIES = (("return", "Return per episode"), ("cost_per_1000", "Cost per 1000 env steps"), ("multiplier", "Multiplier"))
SETS = {"held_out": ("held-out episodes", PALETTE[6]), "unseen": ("unseen operators", PALETTE[4])}
"""Sets of the diagnostics: name and colour."""
RANKED = (("auprc", "-", "o", "model"), ("persistence", "--", "", "persistence"), ("base", ":", "", "base rate"))
"""Lines of the AUPRC over the imagined step: key, style, marker and name."""
FURTHER = (
    ("predicted_over_base", "predicted cost / base rate"), ("reward_r2", "reward R2"), ("image_over_copy", "image error / error of a copy")
)  # fmt: skip
"""What the other panels over the imagined step show: key and title."""
GROUPS, POINTS = 10, 1500
"""Groups of equally many decisions in a reliability diagram, and decisions that are drawn as points at most."""
PAIRS = 5_000_000
"""Decisions that a file of pairs may have."""
NAME = 60
"""Characters of a name that are drawn at most."""
HORIZON = 500
"""Imagined steps that are drawn at most."""


@contextmanager
def _png(size: tuple[float, float], path: Path) -> Iterator[Figure]:
    """A figure that is written when it is filled."""
    with drawn(size) as figure:
        yield figure
        save_png(figure, path)


def draw_learning_curve(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw return, cost with its limit, and multiplier over the interactions, one below the other.

    Rollouts in which no episode ended have no return and leave a gap.
    """
    rows, config = rows_of(read_json(layout, artifact, "curve.json")), config_of(layout, artifact)
    if not rows:
        return
    limit = config.get("cost_limit") if config.get("mode", "lagrangian") == "lagrangian" else None
    x = 1e-3 * column_of(rows, "interactions")
    with _png((6.0, 5.4), path) as figure:
        panels = figure.subplots(len(QUANTITIES), 1, sharex=True)
        for panel, (name, title) in zip(panels, QUANTITIES, strict=True):
            draw_lines(panel, [Line(x, column_of(rows, name), gaps=True)])
            panel.set_title(title, loc="left")
        if isinstance(limit, int | float):
            panels[1].axhline(limit, color=PALETTE[4], linestyle="--", linewidth=1.0, label=f"limit {limit:g}")
            panels[1].legend(frameon=False, loc="upper right")
        panels[-1].set_xlabel("Interactions in thousands of decision steps")


def draw_cost_reliability(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw, for some imagined steps, the share of costs that was seen over the predicted probability; marks grow with their starts."""
    steps = {name: {row.get("k"): row for row in table} for name, table in _diagnosed(layout, artifact).items()}
    shown = [k for k in STEPS if any(k in table for table in steps.values())]
    if not shown:
        return
    with _png((3.6 * len(shown), 3.4), path) as figure:
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        for panel, k in zip(panels, shown, strict=True):
            lines = []
            for name, table in steps.items():
                bins = [row for row in rows_of(table.get(k, {}).get("reliability")) if row.get("size")]
                areas = 12.0 * np.log10(1.0 + column_of(bins, "size")) ** 1.5
                title, colour = SETS[name]
                label = f"{title}, ECE {table[k]['calibration_error']:.3f}" if k in table else ""
                lines.append(Line(column_of(bins, "predicted"), column_of(bins, "seen"), label, colour, width=1.0, areas=areas))
            limits = {"xlim": (-0.03, 1.03), "ylim": (-0.03, 1.03)}
            draw_lines(panel, lines, diagonal=(0.0, 1.0), title=f"step {k}", xlabel="predicted probability of a cost", **limits)
            panel.legend(frameon=False, fontsize=7, loc="upper left")
        panels[0].set_ylabel("share seen")


def draw_horizon(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw over the imagined step: AUPRC with its interval, predicted over base rate, reward R2, image error over that of a copy."""
    sets = {name: rows for name, rows in _diagnosed(layout, artifact).items() if rows}
    if not sets:
        return
    first, last = next(iter(sets)), max(len(rows) for rows in sets.values())
    with _png((14.4, 3.4), path) as figure:
        panels = figure.subplots(1, 4, squeeze=False)[0]
        ranked, further = [], []
        for name, rows in sets.items():
            title, colour = SETS[name]
            k = column_of(rows, "k")
            panels[0].fill_between(k, column_of(rows, "auprc_low"), column_of(rows, "auprc_high"), color=colour, alpha=0.15, linewidth=0)
            for key, style, marker, text in RANKED:
                label = text if name == first else ""  # colours are named in the other panels
                ranked.append(Line(k, column_of(rows, key), label, colour, style, marker, gaps=True))
            further.append([Line(k, column_of(rows, key), title, colour, marker="o", gaps=True) for key, _ in FURTHER])
        common: dict[str, Any] = {"xlabel": "imagined step", "xticks": [1, *range(5, 1 + last, 5)]}
        draw_lines(panels[0], ranked, title="cost AUPRC", **common)
        for i, (_, title) in enumerate(FURTHER):
            draw_lines(panels[1 + i], [lines[i] for lines in further], title=title, **common)
        for panel in panels:
            panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
            panel.legend(frameon=False, fontsize=7)
        panels[0].set_ylim(0.0, 1.0)
        for panel in (panels[1], panels[3]):
            panel.axhline(1.0, color=GREY, linewidth=0.8)
            panel.set_ylim(top=max(1.3, panel.get_ylim()[1]))
        panels[1].axhspan(0.8, 1.25, color="#eeeeee", zorder=0)


def draw_value_reliability(layout: Layout, artifact: Trained, path: Path) -> None:
    """Draw what critics predicted beside what followed: every decision as a point, and the means of ten equally large groups.

    On the diagonal a critic is right on average.
    """
    table = read_table(layout, artifact, "pairs.parquet", ("critic", "predicted", "real"), PAIRS)
    names = np.asarray(table["critic"].to_pylist(), str)
    predicted, real = (np.asarray(table[name], np.float64) for name in ("predicted", "real"))
    critics = list(dict.fromkeys(names.tolist()))[:4]
    if not critics:
        return
    with _png((4.0 * len(critics), 3.8), path) as figure:
        panels = figure.subplots(1, len(critics), squeeze=False)[0]
        for panel, name in zip(panels, critics, strict=True):
            x, y = predicted[names == name], real[names == name]
            shown = np.linspace(0, len(x) - 1, min(POINTS, len(x))).astype(int)
            groups = [group for group in np.array_split(np.argsort(x, kind="stable"), GROUPS) if len(group)]
            mean_x, mean_y = (np.array([values[group].mean() for group in groups]) for values in (x, y))
            points = Line(x[shown], y[shown], colour=PALETTE[2], style="none", marker=".", size=2.0, alpha=0.4)
            lines = [points, Line(mean_x, mean_y, colour=PALETTE[4], marker="o", size=4.0)]
            ends = (float(min(x.min(), y.min())), float(max(x.max(), y.max())))
            draw_lines(panel, lines, diagonal=ends, xlabel=f"{name[:NAME]}, predicted", ylabel="discounted sum that followed")


def _diagnosed(layout: Layout, artifact: Trained) -> Mapping[str, list[Mapping[str, Any]]]:
    """The rows per imagined step, by set of episodes."""
    document = read_json(layout, artifact, "diagnostics.json")
    return {name: rows_of(document[name]["steps"])[:HORIZON] for name in SETS if name in document}
