"""Curves and tables as series of numbers, for TensorBoard and Trackio.

There a trained part is a run such as `goal1/s1/Expert`, with its curves over decision steps or
updates. An assistant is a run such as `goal1/table/WASP`, with one point a column of the main
table.
"""

from __future__ import annotations

import io
import math
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path

from wasp_cli.cells.table import Floats
from wasp_cli.errors import UsageError
from wasp_cli.report.stats import Frame
from wasp_cli.report.tables.main import full_groups, main_table
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.figures import driving_curves, loss_curves
from wasp_cli.store.layout import Layout

Runs = dict[str, dict[int, dict[str, float]]]  # by name of a run and by step, the numbers there


def series_of(layout: Layout, trained: Sequence[Trained], frame: Frame) -> Runs:
    """Return the curves of all trained parts, and each row of the main table as a run with one
    step.
    """
    runs: Runs = {}
    for curve in driving_curves(layout, trained):
        _add(runs.setdefault(f"{curve.task}/s{curve.seed}/{curve.name}", {}), curve.x, curve.y)
    for curve in loss_curves(layout, trained):  # each is a term of the loss, over its first value
        points = runs.setdefault(f"{curve.task}/s{curve.seed}/World model", {})
        _add(points, curve.x, {f"loss, {curve.name}": curve.y["loss"]})
    table = main_table(frame)
    for group, row in zip(full_groups(frame), table.rows, strict=True):
        pairs = zip(table.columns, row.values, strict=True)
        numbers = {
            column.key: value.mean * column.scale
            for column, value in pairs
            if value.mean is not None
        }
        runs[f"{group.task}/table/{row.labels[1]}"] = {0: numbers}
    return runs


def _add(points: dict[int, dict[str, float]], x: Floats, y: Mapping[str, Floats]) -> None:
    for name, values in y.items():
        for step, value in zip(x, values, strict=False):
            if math.isfinite(value):
                points.setdefault(int(step), {})[name] = float(value)


def to_tensorboard(name: str, runs: Runs, folder: Path) -> int:
    """Write event files to `folder/name`, a folder for each run; return how many runs there are.

    Raises:
        UsageError: tensorboard is not installed, or the folder is there already.
    """
    try:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter
    except ImportError as error:
        raise UsageError(
            "--tensorboard needs the package 'tensorboard'", "pip install 'wasp-cli[export]'"
        ) from error
    target = _new(folder / name)
    for run, points in runs.items():
        writer = EventFileWriter(str(target / run))
        for step, numbers in points.items():
            values = [Summary.Value(tag=tag, simple_value=value) for tag, value in numbers.items()]
            writer.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
        writer.close()
    return len(runs)


def to_trackio(name: str, runs: Runs, folder: Path) -> int:
    """Write a Trackio project to `folder`; return how many runs it has.

    Raises:
        UsageError: trackio is not installed, or the project is there already.
    """
    _new(folder / f"{name}.db")
    os.environ["TRACKIO_DIR"] = str(folder.resolve())  # read when the package is imported
    try:
        import trackio
    except ImportError as error:
        raise UsageError(
            "--trackio needs the package 'trackio'", "pip install 'wasp-cli[export]'"
        ) from error
    with redirect_stdout(io.StringIO()):  # it prints three lines for each run
        for run, points in runs.items():
            series = trackio.init(
                project=name,
                name=run,
                resume="never",
                embed=False,
                auto_log_gpu=False,
                auto_log_cpu=False,
            )
            for step, numbers in points.items():
                series.log(numbers, step=step)
            series.finish()  # type: ignore[no-untyped-call]
    return len(runs)


def _new(path: Path) -> Path:
    """Return a path that must not exist yet, since a second export would be shown beside the first
    under the same names. Raises UsageError if it does.
    """
    if path.exists():
        raise UsageError(f"'{path}' is there already", "remove it, or export to another folder")
    return path
