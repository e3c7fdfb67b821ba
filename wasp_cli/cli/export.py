"""`wasp export`: curves and tables for TensorBoard and Trackio."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.parameters import directory, option
from wasp_cli.cli.runs import reported_runs
from wasp_cli.console import say
from wasp_cli.errors import (
    ArtifactError,
    UsageError,
)


@command(
    "wasp export results/ --tensorboard runs/",
    "wasp export results/ --spec quickstart --trackio trackio/",
)
def export(
    results: options.Folder,
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran)")
    ] = None,
    tensorboard: Annotated[Path | None, directory("Write event files to DIR/<spec>.")] = None,
    trackio: Annotated[Path | None, directory("Write Trackio projects to DIR, one a spec.")] = None,
) -> None:
    """Write curves and tables for TensorBoard or Trackio.

    Only stored results are read. Look at them with `tensorboard --logdir DIR`, or `TRACKIO_DIR=DIR
    trackio show`.
    """
    from wasp_cli.report.summarize import report_run
    from wasp_cli.report.trained.series import series_of, to_tensorboard, to_trackio
    from wasp_cli.run.record import read_run

    if tensorboard is None and trackio is None:
        raise UsageError(
            "nothing to write: neither --tensorboard nor --trackio is given",
            "wasp export results/ --tensorboard runs/",
        )
    layout, runs, damaged = reported_runs(results.path, spec)
    for name, run_id in runs.items():
        ran = read_run(layout, run_id)
        report = report_run(
            layout.root, ran.spec, ran.cells, ran.parts, None, ran.branched, ran.unknown, ran.absent
        )
        for folder, write in ((tensorboard, to_tensorboard), (trackio, to_trackio)):
            if folder is not None:
                series = series_of(report.layout, report.trained, report.frame)
                count = write(name, series, folder)
                say(f"{name}: {count} runs in {folder}")
    if damaged:
        raise ArtifactError(
            "\n".join(["part of the results cannot be read:", *(f"  {text}" for text in damaged)])
        )
