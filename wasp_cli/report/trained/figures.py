"""Figures of trained parts, of one or of all: how they learned, and how well their predictions come
true. Artifacts with files of another form are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from wasp_cli.cells.table import Floats
from wasp_cli.errors import WaspError
from wasp_cli.report.canvas import drawn
from wasp_cli.report.styles import GREY, PALETTE, Line, draw_lines
from wasp_cli.report.tables import task_title
from wasp_cli.report.trained.artifacts import UNREADABLE, Trained, column_of, read_json, read_table
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MARKERS = ("o", "s", "^", "D")
LINES = ("-", "--", "-.", ":")
SMOOTHED = 7  # points of a loss that are averaged, since small batches make them noisy
EPISODES = {
    "held_out": ("held-out episodes", PALETTE[6]),
    "unseen": ("operators not in the data", PALETTE[4]),
}
"""Sets of episodes that a world model is judged by: name and colour."""
QUANTITIES = {
    "return": "return per episode",
    "cost_per_1000": "cost per 1000 env steps",
    "multiplier": "multiplier",
    "loss": "world model, loss / first loss",
}
"""What a learning curve may show, a panel each."""
DRIVING = {  # stages that learn in the task: file of the curve, name in figures
    "expert": ("curve.json", "Expert"),
    "policies": ("reinforcement.json", "Latent expert"),
    "residual": ("curve.json", "SafeRL-Res"),
}
LOSSES = {
    "beta_o": "observations",
    "beta_r": "reward",
    "beta_c": "cost",
    "ahead_c": "cost, imagined",
}
"""Terms of the world model's loss (Eq. 6 and the imagined one) that a figure shows."""
UPDATES_PER_POINT = 20  # of the world model's curves
STEPS = (1, 5, 10, 15)  # imagined steps whose reliability a figure shows
COLOURS = (1, 6, 3, 4)  # by step, in the palette
RANKED = (
    ("auprc", "-", "o", "model"),
    ("persistence", "--", "", "persistence"),
    ("base", ":", "", "base rate"),
)
"""Lines of the AUPRC over the imagined step: key, style, marker and name."""
FURTHER = (
    ("predicted_over_base", "predicted cost / base rate"),
    ("reward_r2", "reward R2"),
)
"""What the other panels over the imagined step show: key and title."""
OVER_COPY = {
    "image": ("image_over_copy", "image error / error of a copy"),
    "vector": ("vector_over_copy", "vector error / error of a copy"),
}
"""The last of them, by what the world model sees."""
GROUPS = 10  # of equally many decisions, in a reliability diagram
POINTS = 1500  # decisions that are drawn as points at most


@dataclass(frozen=True, eq=False)
class Curve:
    """How some quantities changed while a part was trained."""

    task: str
    seed: int
    name: str
    x: Floats
    y: Mapping[str, Floats]  # by quantity; NaN is a gap
    limit: float | None = None  # of the cost per 1000 env steps; None: none


class Reliability(NamedTuple):
    """How often imagined costs came true, in bins of their predicted probability."""

    task: str
    seed: int
    episodes: str  # `held_out` or `unseen`
    step: int
    predicted: Floats  # [bins]
    seen: Floats  # [bins]
    size: Floats  # [bins] rows behind them
    error: float  # expected calibration error; NaN where it is not told


def draw_learning(layout: Layout, trained: Sequence[Trained]) -> Figure | None:
    """Draw return, cost and multiplier of the parts that learn in the task, and the losses of the
    world model; a row for each task. None without any.

    All seeds of a name look the same. A rollout in which no episode ended has no return.
    """
    curves = driving_curves(layout, trained)
    curves += [_smoothed(curve) for curve in loss_curves(layout, trained)]
    tasks = list(dict.fromkeys(curve.task for curve in curves))
    shown = [
        quantity
        for quantity in QUANTITIES
        if any(np.isfinite(curve.y.get(quantity, np.nan)).any() for curve in curves)
    ]
    if not tasks or not shown:
        return None
    with drawn((0.4 + 3.1 * len(shown), 0.5 + 2.5 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(shown), squeeze=False)
        for row, task in zip(panels, tasks, strict=True):
            for panel, quantity in zip(row, shown, strict=True):
                _draw_quantity(panel, curves, task, quantity)
        return figure


def _smoothed(curve: Curve) -> Curve:
    """The moving average of a curve."""
    width = min(SMOOTHED, len(curve.x))
    window = np.ones(width) / width
    middle = curve.x[(width - 1) // 2 :][: len(curve.x) - width + 1]
    smooth = {name: np.convolve(values, window, "valid") for name, values in curve.y.items()}
    return replace(curve, x=middle, y=smooth)


def _draw_quantity(panel: Any, curves: Sequence[Curve], task: str, quantity: str) -> None:
    """Draw one quantity of a task over its training; with its limit if it is the cost."""
    own = [curve for curve in curves if quantity in curve.y]
    # Looks are given over all tasks, so that a name looks the same in every panel.
    names = list(dict.fromkeys(curve.name for curve in own))
    place = {name: i for i, name in enumerate(names)}
    of_task = [curve for curve in own if curve.task == task]
    lines = [
        Line(
            1e-3 * curve.x,
            curve.y[quantity],
            curve.name,
            PALETTE[place[curve.name] % len(PALETTE)],
            LINES[place[curve.name] % len(LINES)],
            alpha=0.85,
        )
        for curve in of_task
    ]
    is_loss = quantity == "loss"
    draw_lines(
        panel,
        lines,
        xlabel="thousand updates" if is_loss else "thousand decision steps",
        yscale="log" if is_loss else "linear",
    )
    panel.set_title(f"{task_title(task)}: {QUANTITIES[quantity]}", loc="left")
    if quantity == "cost_per_1000":
        for limit in sorted({curve.limit for curve in of_task if curve.limit is not None}):
            panel.axhline(
                limit, color=GREY, linestyle="--", linewidth=1.0, label=f"limit {limit:g}"
            )
    if panel.get_legend_handles_labels()[0]:
        panel.legend(frameon=False, fontsize=7, handlelength=2.4)


def draw_reliability(layout: Layout, trained: Sequence[Trained]) -> Figure | None:
    """Draw how often an imagined cost came true, by its predicted probability; a row for each task,
    a column for each set of episodes. None without any.
    """
    diagrams = list(reliabilities(layout, trained))
    tasks = list(dict.fromkeys(each.task for each in diagrams))
    if not tasks:
        return None
    kinds = [
        episodes for episodes in EPISODES if any(each.episodes == episodes for each in diagrams)
    ]
    with drawn((0.4 + 3.6 * len(kinds), 0.5 + 3.2 * len(tasks))) as figure:
        panels = figure.subplots(len(tasks), len(kinds), squeeze=False, sharex=True, sharey=True)
        for row, task in zip(panels, tasks, strict=True):
            for panel, episodes in zip(row, kinds, strict=True):
                own = [each for each in diagrams if (each.task, each.episodes) == (task, episodes)]
                lines = list(_reliable(own))
                draw_lines(
                    panel, lines, diagonal=(0.0, 1.0), xlabel="predicted probability of a cost"
                )
                panel.grid(visible=False)
                panel.set_title(
                    f"{task_title(task)}: {EPISODES[episodes][0]}", loc="left", fontsize=9
                )
                if lines:
                    panel.legend(
                        frameon=False,
                        fontsize=7,
                        loc="upper left",
                        title="steps ahead",
                        title_fontsize=7,
                    )
            row[0].set_ylabel("share with a cost")
        return figure


def _reliable(diagrams: Sequence[Reliability]) -> Iterator[Line]:
    """The lines of diagrams, one for each seed and imagined step; the first of a step has its
    label.
    """
    for i, step in enumerate(STEPS):
        own = [each for each in diagrams if each.step == step]
        errors = [each.error for each in own if np.isfinite(each.error)]
        label = f"{step}, ECE {np.mean(errors):.3f}" if errors else str(step)
        for each in own:
            here = each.size > 0
            colour = PALETTE[COLOURS[i]]
            areas = 6.0 + 10.0 * np.log10(each.size[here])
            x = each.predicted[here]
            y = each.seen[here]
            yield Line(x, y, label, colour, LINES[i], MARKERS[i], width=0.9, areas=areas, alpha=0.8)


def driving_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Return the learning curves of the parts that learn in the task, over decision steps. Curves
    of another form are left out.
    """
    curves = []
    for artifact in trained:
        if artifact.kind not in DRIVING:
            continue
        file, name = DRIVING[artifact.kind]
        with suppress(*UNREADABLE):
            rows = read_json(layout, artifact, file)
            x = column_of(rows, "interactions")
            if len(x) > 1 and np.isfinite(x).all():
                config: Any = {}
                with suppress(WaspError):  # without a manifest there is no limit
                    config = read_manifest(layout, artifact.kind, artifact.key).get("config") or {}
                limit = None
                if config.get("mode", "lagrangian") == "lagrangian":
                    # If the section has `auto`, the summary has the limit that was chosen.
                    limit = artifact.summary.get("cost_limit", config.get("cost_limit"))
                numbers = {
                    key: column_of(rows, key) for key in ("return", "cost_per_1000", "multiplier")
                }
                curves.append(
                    Curve(
                        artifact.task,
                        artifact.seed,
                        name,
                        x,
                        numbers,
                        None if limit is None else float(limit),
                    )
                )
    return curves


def loss_curves(layout: Layout, trained: Iterable[Trained]) -> list[Curve]:
    """Return the terms of each world model's loss over its updates, each over its first value."""
    losses = []
    for artifact in trained:
        if artifact.kind != "world_model":
            continue
        with suppress(*UNREADABLE):
            curves = read_json(layout, artifact, "curves.json")
            for term, title in LOSSES.items():
                values = np.array(curves.get(term, ()), np.float64)
                if len(values) > 1 and values[0] > 0:
                    x = UPDATES_PER_POINT * np.arange(len(values), dtype=np.float64)
                    losses.append(
                        Curve(artifact.task, artifact.seed, title, x, {"loss": values / values[0]})
                    )
    return losses


def diagnosed(layout: Layout, artifact: Trained) -> dict[str, list[Mapping[str, Any]]]:
    """Return what `diagnostics` measured: by set of episodes, a row for each imagined step. Raises
    one of UNREADABLE.
    """
    sets = read_json(layout, artifact, "diagnostics.json")
    return {name: sets[name]["steps"] for name in EPISODES if name in sets and sets[name]["steps"]}


def reliabilities(layout: Layout, trained: Iterable[Trained]) -> Iterator[Reliability]:
    """Yield the reliability diagrams of imagined costs that a figure shows."""
    for artifact in [artifact for artifact in trained if artifact.kind == "diagnostics"]:
        with suppress(*UNREADABLE):
            for episodes, rows in diagnosed(layout, artifact).items():
                for row in rows:
                    bins = row.get("reliability")
                    if row["k"] in STEPS and bins:
                        (error,) = column_of([row], "calibration_error").tolist()
                        yield Reliability(
                            artifact.task,
                            artifact.seed,
                            episodes,
                            row["k"],
                            column_of(bins, "predicted"),
                            column_of(bins, "seen"),
                            column_of(bins, "size"),
                            error,
                        )


def draw_horizon(layout: Layout, trained: Sequence[Trained]) -> Figure | None:
    """Draw how the predictions of cost, reward and observation become worse with every imagined
    step; a colour for each set of episodes. None if nothing was measured. Raises one of UNREADABLE.
    """
    (artifact,) = trained
    sets = diagnosed(layout, artifact)
    if not sets:
        return None

    # The lines of each panel: of the AUPRC first, then of the others.
    first = next(iter(sets))
    last = max(len(rows) for rows in sets.values())
    of_vectors = any("vector_over_copy" in row for rows in sets.values() for row in rows)
    others = (*FURTHER, OVER_COPY["vector" if of_vectors else "image"])
    with drawn((14.4, 3.4)) as figure:
        panels = figure.subplots(1, 4, squeeze=False)[0]
        ranked: list[Line] = []
        further: list[list[Line]] = []
        for name, rows in sets.items():
            title, colour = EPISODES[name]
            k = column_of(rows, "k")
            panels[0].fill_between(
                k,
                column_of(rows, "auprc_low"),
                column_of(rows, "auprc_high"),
                color=colour,
                alpha=0.15,
                linewidth=0,
            )
            for key, style, marker, text in RANKED:
                label = text if name == first else ""  # colours are named in the other panels
                ranked.append(
                    Line(k, column_of(rows, key), label, colour, style, marker, gaps=True)
                )
            further.append(
                [
                    Line(k, column_of(rows, key), title, colour, marker="o", gaps=True)
                    for key, _ in others
                ]
            )
        common: dict[str, Any] = {"xlabel": "imagined step", "xticks": [1, *range(5, 1 + last, 5)]}
        draw_lines(panels[0], ranked, title="cost AUPRC", **common)
        for i, (_, title) in enumerate(others):
            draw_lines(panels[1 + i], [lines[i] for lines in further], title=title, **common)
        for panel in panels:
            panel.set_ylim(bottom=min(0.0, panel.get_ylim()[0]))
            panel.legend(frameon=False, fontsize=7)
        panels[0].set_ylim(0.0, 1.0)
        for panel in (panels[1], panels[3]):
            panel.axhline(1.0, color=GREY, linewidth=0.8)
            panel.set_ylim(top=max(1.3, panel.get_ylim()[1]))
        panels[1].axhspan(0.8, 1.25, color="#eeeeee", zorder=0)
        return figure


def draw_value_reliability(layout: Layout, trained: Sequence[Trained]) -> Figure | None:
    """Draw what critics predicted against what followed: every decision as a point, and the means
    of GROUPS equally large groups. On the diagonal a critic is right on average. None without
    critics; raises one of UNREADABLE.
    """
    (artifact,) = trained
    table = read_table(layout, artifact, "pairs.parquet", ("critic", "predicted", "real"))
    names = np.asarray(table["critic"].to_pylist(), str)
    predicted = np.asarray(table["predicted"], np.float64)
    real = np.asarray(table["real"], np.float64)
    critics = list(dict.fromkeys(names.tolist()))[:4]
    if not critics:
        return None
    with drawn((4.0 * len(critics), 3.8)) as figure:
        panels = figure.subplots(1, len(critics), squeeze=False)[0]
        for panel, name in zip(panels, critics, strict=True):
            of_critic = names == name
            x = predicted[of_critic]
            y = real[of_critic]
            shown = np.linspace(0, len(x) - 1, min(POINTS, len(x))).astype(int)
            groups = [
                group
                for group in np.array_split(np.argsort(x, kind="stable"), GROUPS)
                if len(group)
            ]
            mean_x = np.array([x[group].mean() for group in groups])
            mean_y = np.array([y[group].mean() for group in groups])
            points = Line(
                x[shown], y[shown], colour=PALETTE[2], style="none", marker=".", size=2.0, alpha=0.4
            )
            lines = [points, Line(mean_x, mean_y, colour=PALETTE[4], marker="o", size=4.0)]
            ends = (float(min(x.min(), y.min())), float(max(x.max(), y.max())))
            draw_lines(
                panel,
                lines,
                diagonal=ends,
                xlabel=f"{name}, predicted",
                ylabel="discounted sum that followed",
            )
        return figure
