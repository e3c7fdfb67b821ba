"""What is stored, for TensorBoard and Trackio: learning curves of trained parts, and the numbers of the main table.

A trained part is a run such as `goal1/s1/Expert`, with its curves over decision steps or updates. An assistant is a run such as
`goal1/table/WASP`, with one point a column of the main table.
"""

from __future__ import annotations

import io
import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import NamedTuple

from wasp_cli.errors import UsageError
from wasp_cli.report.summarize import Report
from wasp_cli.report.tables.main import main_table
from wasp_cli.report.trained.figures import driving_curves, loss_curves
from wasp_cli.report.trained.parts import Floats


class Series(NamedTuple):
    """A run: its name, and per step the numbers by their names."""

    name: str
    points: Mapping[int, Mapping[str, float]]


def series_of(report: Report) -> Iterator[Series]:
    runs: dict[str, dict[int, dict[str, float]]] = {}
    for curve in driving_curves(report.layout, report.trained):
        _add(runs.setdefault(f"{curve.task}/s{curve.seed}/{curve.name}", {}), curve.x, curve.y)
    for curve in loss_curves(report.layout, report.trained):  # a curve a term of the loss, over its first value
        _add(runs.setdefault(f"{curve.task}/s{curve.seed}/World model", {}), curve.x, {f"loss, {curve.name}": curve.y["loss"]})
    table = main_table(report.frame)
    for row in table.rows:
        pairs = zip(table.columns, row.values, strict=True)
        numbers = {column.key: value.mean * column.scale for column, value in pairs if value.mean is not None}
        runs["/".join([row.labels[0].lower(), "table", row.labels[1]])] = {0: numbers}
    for name, points in runs.items():
        yield Series(name, points)


def _add(points: dict[int, dict[str, float]], x: Floats, y: Mapping[str, Floats]) -> None:
    for name, values in y.items():
        for step, value in zip(x, values, strict=False):
            if math.isfinite(value):
                points.setdefault(int(step), {})[name] = float(value)


def to_tensorboard(report: Report, folder: Path) -> int:
    try:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter
    except ImportError as error:
        raise UsageError("--tensorboard needs the package 'tensorboard'", "pip install 'wasp-cli[export]'") from error
    target = _new(folder / report.name)
    count = 0
    for series in series_of(report):
        writer = EventFileWriter(str(target / series.name))
        for step, numbers in series.points.items():
            values = [Summary.Value(tag=name, simple_value=value) for name, value in numbers.items()]
            writer.add_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
        writer.close()
        count += 1
    return count


def to_trackio(report: Report, folder: Path) -> int:
    _new(folder / f"{report.name}.db")
    os.environ["TRACKIO_DIR"] = str(folder.resolve())  # read when the package is imported
    try:
        import trackio
    except ImportError as error:
        raise UsageError("--trackio needs the package 'trackio'", "pip install 'wasp-cli[export]'") from error
    count = 0
    with redirect_stdout(io.StringIO()):  # it tells three lines a run
        for series in series_of(report):
            run = trackio.init(project=report.name, name=series.name, resume="never", embed=False, auto_log_gpu=False, auto_log_cpu=False)
            for step, numbers in series.points.items():
                run.log(dict(numbers), step=step)
            run.finish()  # type: ignore[no-untyped-call]
            count += 1
    return count


def _new(path: Path) -> Path:
    """Return a path that is not there yet: a second export would stand beside the first under the same names. Raises UsageError."""
    if path.exists():
        raise UsageError(f"'{path}' is there already", "remove it, or export to another folder")
    return path
