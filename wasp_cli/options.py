"""What the commands share: their options, how expected errors end them, and what a run without some of its rows ends with."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ParamSpec, TypeVar

import typer

if TYPE_CHECKING:
    from wasp_cli.report.frame import Missing

P = ParamSpec("P")
R = TypeVar("R")

INTERRUPTED = 130
PIPE_CLOSED = 141

SpecArgument = Annotated[Path, typer.Argument(metavar="SPEC", help="A YAML file, for example specs/quickstart.yaml.", show_default=False)]


def folder_of(value: str | Path) -> Path:
    """A folder as it was typed; an empty name is refused."""
    if not str(value).strip():  # an unset variable of a script; Path("") would be the current folder
        raise typer.BadParameter("the name of the folder is empty")
    return Path(value)


ResultsOption = Annotated[Path, typer.Option("--results", metavar="DIR", parser=folder_of, help="Where results are kept.")]
TaskOption = Annotated[str | None, typer.Option("--task", "-t", metavar="TASK", help="Only this task of the spec.", show_default=False)]
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
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the spec, as if it stood in the file. Repeatable.",
        show_default=False,
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


def print_json(value: Any) -> None:
    """Print for machines."""
    import json

    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")


def require_cells(missing: Sequence[Missing]) -> None:
    """Raise CellsFailed when a cell has no readable rows, though its node ended well."""
    from wasp_cli.errors import CellsFailed

    if missing:
        named = "\n".join(f"  {cell.label}: {cell.reason}" for cell in missing[:10])
        more = f"\n  and {len(missing) - 10} more" if len(missing) > 10 else ""
        raise CellsFailed(f"{len(missing)} cells cannot be read:\n{named}{more}")
