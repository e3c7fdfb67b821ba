"""Operating points in a report: which value of each assistant's knob was chosen on held-out worlds,
and which assistants are silent because no value helped.

A results folder may be untrusted: files of another form are treated as absent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.errors import ArtifactError, WaspError
from wasp_cli.plan.grid import OPERATING
from wasp_cli.report.canvas import drawn, figure_files
from wasp_cli.report.styles import legend, ruled, style_of
from wasp_cli.report.summary import Value
from wasp_cli.report.tables import Column, Row, Table, task_title, who_title
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout, is_key
from wasp_cli.store.plain import parse, printable, read_plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAME = "operating_points"  # of the table and of the figure
POINT_FILE = "operating_point.json"  # of an artifact of the stage
NUMBERS = ("episodes", "return_", "cost", "effective", "alone_return", "alone_cost")
COLUMNS = (
    Column("episodes", "Episodes", digits=0),
    Column("return", "Return"),
    Column("cost", "Cost"),
    Column("int_eff", "Int. eff."),
    Column("alone_return", "Alone: Return"),
    Column("alone_cost", "Alone: Cost"),
)
MEANINGS = (
    "Means over the held-out episodes of a row; Alone is the operators without an assistant in the "
    "same worlds. A value that had left the race drove fewer worlds.",
    "Of the values that help, those count that keep 98 % of the best return; of these the one of "
    "least cost is chosen, then of least Int. eff. A value helps if it costs less and returns no "
    "less than the operators alone, or returns more and costs no more; where none does, the "
    "assistant is silent.",
)


@dataclass(frozen=True)
class Trial:
    """One value of a knob, as `metrics.operating_point.Point` has it."""

    value: float | None
    episodes: float
    return_: float
    cost: float
    effective: float
    alone_return: float
    alone_cost: float


@dataclass(frozen=True)
class Operating:
    """What the stage found for one assistant."""

    task: str
    seed: int  # of the training
    method: str
    variant: str
    symbol: str  # of the knob; empty where there is none
    silent: bool
    value: float | None  # that was chosen
    best: Trial
    trials: tuple[Trial, ...]

    @property
    def title(self) -> str:
        """The title of the method, with its ablation."""
        return who_title(self.method, self.variant)

    def named(self, value: float | None) -> str:
        """Return a value of the knob in words, such as `κ 0.5`; `as it is` for None."""
        return "as it is" if value is None else f"{self.symbol} {value:g}"


def read_operating(layout: Layout, cells: Iterable[str]) -> list[Operating]:
    """Return the operating points that evaluated cells (their keys) were run at, each once.

    Each is looked for in the results folder, then in the published layer that comes with the
    package: a run copies published cells, but not what they were computed from. Points that cannot
    be read are left out.
    """
    keys: dict[str, None] = {}
    for cell in cells:
        try:
            upstream = read_manifest(layout, KIND, cell)["upstream"]
        except (ArtifactError, LookupError, TypeError):
            continue  # not computed yet, or damaged; the report says so elsewhere
        key = upstream.get(OPERATING) if isinstance(upstream, Mapping) else None
        if isinstance(key, str) and is_key(key):
            keys[key] = None
    layouts = [layout, *_published()]
    points: list[Operating] = []
    for key in keys:
        for each in layouts:
            point = read_point(each, key)
            if point is not None:
                points.append(point)
                break
    return points


def _published() -> list[Layout]:
    """The published layer that comes with the package, if it does and can be read."""
    try:
        folder = published_folder()
    except (WaspError, OSError):
        return []
    if folder is None:
        return []
    return [Layout(folder)]


def read_point(layout: Layout, key: str) -> Operating | None:
    """Return an operating point by the key of its node; None if it is not there or has another
    form.
    """
    try:
        manifest = read_manifest(layout, OPERATING, key)
        path = layout.within(layout.artifact(OPERATING, key) / POINT_FILE)
        return _operating(manifest, parse(read_plain(path)))
    except (LookupError, TypeError, ValueError, AttributeError, OSError, WaspError):
        return None


def _operating(manifest: Mapping[str, Any], document: Mapping[str, Any]) -> Operating:
    variant = manifest["axes"]["method_config"].get("variant", "full")
    value = document["value"]
    return Operating(
        printable(str(manifest["task"])),
        int(manifest["seed"]),
        printable(str(document["method"])),
        printable(str(variant)),
        printable(str((document["knob"] or {}).get("symbol", ""))),
        document["silent"] is True,
        None if value is None else float(value),
        _trial(document["best"]),
        tuple(_trial(point) for point in document["points"]),
    )


def _trial(point: Mapping[str, Any]) -> Trial:
    numbers = {name: float(point[name]) for name in NUMBERS}
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError("a mean is NaN or infinite")
    value = point["value"]
    return Trial(None if value is None else float(value), **numbers)


def silence(point: Operating, *, trainings: int = 1) -> str:
    """Return a sentence that says that an assistant is silent, with the numbers of its best
    setting.

    Args:
        trainings: how many trainings the task has. If there are several, the sentence names the
            one.
    """
    training = f" (training {point.seed})" if trainings > 1 else ""
    best = point.best
    return (
        f"{point.title} is silent on {task_title(point.task)}{training}: on held-out worlds no "
        f"setting of it helped (operators alone: return {best.alone_return:.1f}, cost "
        f"{best.alone_cost:.1f}; the best setting: {best.return_:.1f}, {best.cost:.1f})."
    )


def silences(points: Sequence[Operating]) -> list[str]:
    """Return a sentence for each silent assistant."""
    seeds: dict[str, set[int]] = {}
    for point in points:
        seeds.setdefault(point.task, set()).add(point.seed)
    return [silence(point, trainings=len(seeds[point.task])) for point in points if point.silent]


def operating_table(points: Sequence[Operating]) -> Table | None:
    """Return a table of every value that was tried, and which one was chosen; None without any."""
    rows = []
    for point in points:
        labels = task_title(point.task), point.title, str(point.seed)
        if point.silent:
            # The numbers of a silent assistant are those of the operators alone.
            best = point.best
            alone = (best.alone_return, best.alone_cost)
            rows.append(_row((*labels, "silent, chosen"), (best.episodes, *alone, 0.0, *alone)))
        for trial in point.trials:
            is_chosen = not point.silent and trial.value == point.value
            setting = point.named(trial.value) + (", chosen" if is_chosen else "")
            rows.append(_row((*labels, setting), [getattr(trial, name) for name in NUMBERS]))
    if not rows:
        return None
    return Table(
        NAME,
        "Operating points, on held-out worlds",
        ("Task", "Method", "Training", "Setting"),
        COLUMNS,
        tuple(rows),
        meanings=MEANINGS,
        grouping=3,
        ranked=False,
    )


def _row(labels: tuple[str, ...], numbers: Sequence[float]) -> Row:
    return Row(labels, tuple(Value(number, n=1, ranked=False) for number in numbers))


def operating_figure(points: Sequence[Operating], folder: Path) -> list[Path]:
    """Write `operating_points.png` and `.svg`: the gain in return and the added cost of each value,
    against the effective intervention rate; a column for each task and training. Returns the files.

    Both are differences to the operators alone in the same worlds, since values that left the race
    early drove fewer worlds.
    """
    places = list(dict.fromkeys((point.task, point.seed) for point in points))
    if not places:
        return []
    several = len(places) > len({task for task, _ in places})
    with drawn((1.8 + 3.2 * len(places), 5.6)) as figure:
        panels = figure.subplots(2, len(places), squeeze=False, sharex="col")
        for column, (task, seed) in zip(panels.T, places, strict=True):
            mine = [point for point in points if (point.task, point.seed) == (task, seed)]
            title = f"{task_title(task)}, training {seed}" if several else task_title(task)
            column[0].set_title(title, loc="left", fontweight="bold")
            _curves(column[0], mine, "return_", "alone_return")
            _curves(column[1], mine, "cost", "alone_cost")
            column[1].set_xlabel("effective intervention rate")
        panels[0, 0].set_ylabel("return gained (better: up)")
        panels[1, 0].set_ylabel("cost added (better: down)")
        legend(figure, panels[0], loc="outside right upper")
        return figure_files(figure, folder, NAME)


def _curves(panel: Axes, points: Sequence[Operating], name: str, alone: str) -> None:
    panel.axhline(0.0, color="#999999", linewidth=1, label="operators alone")
    for point in points:
        colour, marker = style_of(point.method)
        trials = sorted(point.trials, key=lambda trial: trial.effective)
        x = [trial.effective for trial in trials]
        y = [getattr(trial, name) - getattr(trial, alone) for trial in trials]
        panel.plot(x, y, "-", marker=marker, markersize=4, color=colour, label=point.title)
        ringed = [(0.0, 0.0)] if point.silent else []
        for trial, place in zip(trials, zip(x, y, strict=True), strict=True):
            if not point.silent and trial.value == point.value:
                ringed.append(place)
        for place in ringed:
            panel.plot(*place, "o", markersize=11, markerfacecolor="none", color=colour)
    ruled(panel)
