"""What the commands share: their options, how expected errors end them, and what a run without some of its rows ends with."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

import typer

from wasp_cli.cli import completion as complete

if TYPE_CHECKING:
    from wasp_cli.report.stats.frame import Missing
    from wasp_cli.run.session import Way
    from wasp_cli.store.layout import Layout

P = ParamSpec("P")
R = TypeVar("R")

INTERRUPTED = 130
PIPE_CLOSED = 141

SpecArgument = Annotated[
    Path,
    typer.Argument(
        metavar="SPEC", help="A YAML file, for example specs/quickstart.yaml.", show_default=False, autocompletion=complete.specs
    ),
]


def folder_of(value: str | Path) -> Path:
    """A folder as it was typed; an empty name is refused."""
    if not str(value).strip():  # an unset variable of a script; Path("") would be the current folder
        raise typer.BadParameter("the name of the folder is empty")
    return Path(value)


ResultsOption = Annotated[Path, typer.Option("--results", metavar="DIR", parser=folder_of, help="Where results are kept.")]
ResultsArgument = Annotated[Path, typer.Argument(metavar="DIR", parser=folder_of, help="A results folder.")]
NodeArgument = Annotated[
    str,
    typer.Argument(metavar="CELL", help="The beginning of a key, or a label ('goal1 s0 wasp laggy=0.7').", show_default=False),
]
StoredCellArgument = Annotated[
    str,
    typer.Argument(
        metavar="CELL", help="The beginning of a key, a label ('goal1 s0 wasp laggy=0.7'), or a cell.parquet.", show_default=False
    ),
]
EpisodeOption = Annotated[int, typer.Option("--episode", "-e", metavar="E", help="Which episode of the cell.", show_default=False)]
TaskOption = Annotated[
    str | None,
    typer.Option("--task", "-t", metavar="TASK", help="Only this task of the spec.", show_default=False, autocompletion=complete.tasks),
]
JobsOption = Annotated[
    int | None,
    typer.Option(
        "--jobs",
        "-j",
        min=0,
        metavar="N",
        help="Worker processes at most; 0 computes in this process. (default: all cores)",
        show_default=False,
    ),
]


def seconds_of(text: str | float) -> float:
    """A time as it is typed: `90`, `90s`, `30m`, `2h`."""
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([smh]?)\s*", str(text))
    seconds = float(found[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[found[2]] if found else 0.0
    if not seconds:
        raise typer.BadParameter(f"'{text}' is no time; write seconds, or 30m, or 2h")
    return seconds


TimeoutOption = Annotated[
    float | None,
    typer.Option(
        "--timeout",
        metavar="TIME",
        parser=seconds_of,
        help="Time that a node may take: 90, 30m, 2h. (default: no limit)",
        show_default=False,
    ),
]
RetriesOption = Annotated[int, typer.Option("--retries", min=0, max=9, metavar="N", help="Further attempts at what fails by chance.")]
BackendOption = Annotated[
    str, typer.Option("--backend", metavar="NAME", envvar="WASP_BACKEND", help="Who provides the workers: loky, dask, ray.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="URL", envvar="WASP_SCHEDULER", help="Address of the dask scheduler or the ray cluster.", show_default=False
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the spec, as if it stood in the file. Repeatable.",
        show_default=False,
        autocompletion=complete.settings,
    ),
]
SelectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--select",
        metavar="FIELD=VALUE,...",
        help="Only these cells: 'task=race1,method=wasp|ida'; with 'stage=world_model' also what is trained. Repeatable.",
        show_default=False,
    ),
]
ReuseOption = Annotated[
    str | None,
    typer.Option(
        "--reuse",
        metavar="none|published|DIR",
        help="Published results to use instead of computing: those in results/published, or in another folder. (default: the spec's)",
        show_default=False,
    ),
]
FailedOption = Annotated[bool, typer.Option("--failed", help="Only what failed before, and what waits for it.")]


def expected_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Show an expected error as one message and end with its exit code; everything else is a bug and keeps its traceback.

    Expected are also the refusals of the system: a full disk, a folder without permission, a reader of stdout that went away.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        from wasp_cli.errors import WaspError

        try:
            result = command(*args, **kwargs)
            sys.stdout.flush()
            return result
        except (WaspError, OSError) as error:
            from wasp_cli.console import report_error, silence
            from wasp_cli.errors import refusal

            if isinstance(error, OSError):
                silence(sys.stdout)  # what it still holds would raise again at the end
            if os.environ.get("WASP_DEBUG"):
                raise
            if isinstance(error, BrokenPipeError):
                raise typer.Exit(PIPE_CLOSED) from None
            expected = error if isinstance(error, WaspError) else refusal(error)
            report_error(expected)
            raise typer.Exit(expected.exit_code) from None
        except KeyboardInterrupt:
            if os.environ.get("WASP_DEBUG"):
                raise
            print("interrupted", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None

    return wrapped


def way_of(jobs: int | None, timeout: float | None, retries: int, backend: str, scheduler: str | None) -> Way:
    """How a run is carried out, from what was typed."""
    from wasp_cli.run.session import Way, cores

    return Way(cores() if jobs is None else jobs, timeout, retries, backend, scheduler)


def print_json(value: Any) -> None:
    """Print for machines."""
    import json

    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")


def require_cells(missing: Sequence[Missing], layout: Layout | None = None) -> None:
    """Raise CellsFailed when a cell has no readable rows, though its node ended well.

    Args:
        missing: the cells without rows.
        layout: the results folder of a run; damaged cells are taken out of use there, so that the next run computes them.
    """
    from wasp_cli.errors import CellsFailed
    from wasp_cli.store.artifact import condemn

    if missing:
        for cell in missing:
            if cell.damaged and layout is not None:
                condemn(layout, cell.kind, cell.key, cell.reason)
        named = "\n".join(f"  {cell.label}: {cell.reason}" for cell in missing[:10])
        more = f"\n  and {len(missing) - 10} more" if len(missing) > 10 else ""
        what = f"{len(missing)} cell{'s' if len(missing) > 1 else ''} cannot be read"
        raise CellsFailed(f"{what}:\n{named}{more}", None if layout is None else "run again: what is damaged is computed again")
