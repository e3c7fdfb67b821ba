"""`wasp export`: results for other programs, as curves and tables, or episode by episode."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from wasp_cli.cli import options
from wasp_cli.cli.command import command
from wasp_cli.cli.options import require_extra
from wasp_cli.cli.parameters import argument, directory, flag, option, parse_folder
from wasp_cli.cli.runs import reported_runs
from wasp_cli.console import err, say, size
from wasp_cli.errors import ArtifactError, UsageError
from wasp_cli.store.layout import Layout

if TYPE_CHECKING:
    from wasp_cli.export.written import Source, Written

EXAMPLE = "wasp export 'goal1 s1 wasp laggy=0.7' --lerobot lerobot/goal1"


@command(
    "wasp export results/ --tensorboard runs/",
    "wasp export 'goal1 s1 wasp laggy=0.7' --minari minari/goal1-wasp-v0",
    EXAMPLE,
    codes="0 done, 1 the results cannot be read, or an episode is not the recorded one, 2 usage, "
    "or packages of an extra are missing",
)
def export(
    what: Annotated[
        list[str] | None,
        argument(
            "[WHAT]...",
            "Of episodes: labels ('goal1 s1 wasp laggy=0.7', 'goal1 s1 dataset', 'person'), or the "
            "beginnings of keys. Also the results folder. (default: all cells of --spec)",
        ),
    ] = None,
    spec: Annotated[
        str | None, option("NAME", "Only the spec of this name. (default: all that ran)")
    ] = None,
    results: options.ResultsOption = options.RESULTS,
    minari: Annotated[
        Path | None,
        directory("Write episodes as a dataset of Minari, called as DIR: minari/mine-v0."),
    ] = None,
    lerobot: Annotated[
        Path | None, directory("Write episodes as a dataset of LeRobot, format v3.0.")
    ] = None,
    tensorboard: Annotated[Path | None, directory("Write event files to DIR/<spec>.")] = None,
    trackio: Annotated[Path | None, directory("Write Trackio projects to DIR, one a spec.")] = None,
    observations: Annotated[
        bool,
        flag(
            "--observations/--no-observations",
            "Export what was seen. Cells do not store it: their actions are carried out again.",
        ),
    ] = True,
    limit: Annotated[
        int | None, option("N", "Only the first N episodes of each cell or dataset.", min=1)
    ] = None,
    force: Annotated[
        bool, flag("--force", "Replace a dataset that is there, once the new one is whole.")
    ] = False,
) -> None:
    """Write results for other programs.

    Curves and tables of specs for TensorBoard (`tensorboard --logdir DIR`) or Trackio
    (`TRACKIO_DIR=DIR trackio show`). Episodes for Minari and LeRobot: datasets of trainings,
    evaluated cells and people's sessions, with command, executed action, gate, cost and the flag of
    an intervention; docs/formats.md has every field.

    The actions of cells are carried out in their task again, for what was seen, and compared with
    the recording. For a gymnasium environment this imports the module that the cell names: only do
    so if you trust it.
    """
    folder, labels = _folder_and_labels(what or [], results)
    curves = tensorboard is not None or trackio is not None
    episodes = minari is not None or lerobot is not None
    if curves and episodes:
        raise UsageError("curves and episodes are exported one after the other", EXAMPLE)
    if not curves and not episodes:
        raise UsageError(
            "nothing to write: none of --minari, --lerobot, --tensorboard and --trackio", EXAMPLE
        )
    if curves:
        if labels or limit or force or not observations:
            raise UsageError(
                "curves are of whole specs: labels, --limit, --force and --no-observations are for "
                "--minari and --lerobot",
                "wasp export results/ --spec NAME --tensorboard runs/",
            )
        _write_curves(folder, spec, tensorboard, trackio)
        return
    if not labels and spec is None:
        raise UsageError(
            "which episodes? Neither a label nor --spec is given",
            f"{EXAMPLE}; or --spec NAME for all cells of a spec",
        )
    if minari is not None:
        require_extra("minari", "minari", "h5py")
    _write_episodes(folder, labels, spec, minari, lerobot, observations, limit, force)


def _folder_and_labels(what: Sequence[str], results: Path) -> tuple[Path, list[str]]:
    """Tell the results folder from labels and keys; a folder of a cell names that cell."""
    from wasp_cli.store.tables import EPISODES_FILE

    folders = [
        text for text in what if os.path.isdir(text) and not (Path(text) / EPISODES_FILE).is_file()
    ]
    labels = [text for text in what if text not in folders]
    given = [parse_folder(text) for text in folders]
    if results != options.RESULTS:
        given.append(results)
    if len(set(given)) > 1:
        named = ", ".join(f"'{folder}'" for folder in given)
        raise UsageError(f"several results folders: {named}", "name one of them")
    return given[0] if given else results, labels


def _write_curves(
    folder: Path, spec: str | None, tensorboard: Path | None, trackio: Path | None
) -> None:
    from wasp_cli.cells.asked import asked_of
    from wasp_cli.report.summarize import report_run
    from wasp_cli.report.trained.series import series_of, to_tensorboard, to_trackio

    _, last = reported_runs(folder, spec)
    for name, run in last.runs.items():
        report = report_run(asked_of(run))
        for target, write in ((tensorboard, to_tensorboard), (trackio, to_trackio)):
            if target is not None:
                series = series_of(report.layout, report.trained, report.frame)
                count = write(name, series, target)
                say(f"{name}: {count} runs in {target}")
    if last.damaged:
        lines = [f"  {text}" for text in last.damaged]
        raise ArtifactError("\n".join(["part of the results cannot be read:", *lines]))


def _write_episodes(
    folder: Path,
    labels: Sequence[str],
    spec: str | None,
    minari: Path | None,
    lerobot: Path | None,
    observations: bool,
    limit: int | None,
    force: bool,
) -> None:
    from wasp_cli.export.lerobot_file import require_lerobot_place, write_lerobot
    from wasp_cli.export.selection import selected
    from wasp_cli.export.written import source_of
    from wasp_cli.run.cores import threads_here

    # -- refuse what cannot be done, before anything is read or played
    targets: list[tuple[Path, Callable[[Source, Path], Written]]] = []
    if minari is not None:
        from wasp_cli.export.minari_file import require_minari_place, write_minari

        require_minari_place(minari, force=force)
        targets.append((minari, write_minari))
    if lerobot is not None:
        require_lerobot_place(lerobot, force=force)
        targets.append((lerobot, write_lerobot))

    # -- read, play and write
    layout = Layout(folder.absolute())
    nodes = selected(layout, labels, spec)
    source = source_of(
        layout,
        nodes,
        observations=observations,
        limit=limit,
        threads=threads_here(),
        told=cache(say),  # once, also where two formats are written
    )
    for target, write in targets:
        with err().status(f"writing {target}"):
            written = write(source, target)
        count = f"{written.episodes} episodes, {written.decisions} decisions"
        say(f"{target}: {count}, {size(written.size)}", f"  {written.load}")
