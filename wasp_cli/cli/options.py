"""What the commands share: arguments and options, how expected errors end a command, and JSON."""

from __future__ import annotations

import functools
import inspect
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar

import typer

from wasp_cli.cli import completion as complete
from wasp_cli.cli.early import INTERRUPTED, end_in_order

P = ParamSpec("P")
R = TypeVar("R")

PIPE_CLOSED = 141

option = functools.partial(typer.Option, show_default=False)
argument = functools.partial(typer.Argument, show_default=False)
"""Those whose default is None, or is explained in the help."""
flag = functools.partial(typer.Option, metavar="")
"""A switch, which takes no value: the help names no type."""


def parse_folder(value: str | Path) -> Path:
    """Return a folder as it was typed; refuse an empty name."""
    if not str(value).strip():  # an unset variable of a script; Path("") would be the current folder
        raise typer.BadParameter("the name of the folder is empty")
    return Path(value)


def parse_duration(text: str | float) -> float:
    """Return the seconds of a duration as it is typed: `90`, `90s`, `30m`, `2h`."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([smh]?)\s*", str(text))
    seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if not seconds:
        raise typer.BadParameter(f"invalid duration '{text}'; write seconds (90), minutes (30m) or hours (2h)")
    return seconds


SpecArgument = Annotated[
    Path,
    argument(metavar="SPEC", help="A YAML file, or a name such as quickstart.", autocompletion=complete.specs),
]
ResultsOption = Annotated[Path, typer.Option("--results", metavar="DIR", parser=parse_folder, help="The results folder.")]
ResultsArgument = Annotated[
    Path | None, argument(metavar="[DIR]", parser=parse_folder, help="The results folder. (default: what --results says)")
]
NodeArgument = Annotated[str, argument(metavar="NODE", help="A label ('goal1 s1 world_model'), or the beginning of a key.")]
StoredCellArgument = Annotated[
    str, argument(metavar="CELL", help="A label ('goal1 s1 wasp laggy=0.7'), the beginning of a key, or an episodes.parquet.")
]
EpisodeOption = Annotated[int, option("--episode", "-e", metavar="E", help="The episode, counted from 0.")]
TaskOption = Annotated[
    list[str] | None,
    option("--task", "-t", metavar="TASK", help="Only this task of the spec (repeatable).", autocompletion=complete.tasks),
]
MethodOption = Annotated[
    list[str] | None,
    option("--method", "-m", metavar="NAME", help="Only this method of the spec (repeatable).", autocompletion=complete.methods),
]
PresetOption = Annotated[
    str | None,
    option("--preset", metavar="NAME", help="Sizes and budgets. (default: what the spec says)", autocompletion=complete.presets),
]
RunOption = Annotated[
    str | None,
    option("--run", metavar="ID", help="The run: a folder name in runs/, its end, or a spec's name. (default: the newest)"),
]
JobsOption = Annotated[
    int | None,
    option("--jobs", "-j", min=0, metavar="N", help="At most N worker processes; 0 computes in this process. (default: all cores)"),
]
TimeoutOption = Annotated[
    float | None,
    option("--timeout", metavar="TIME", parser=parse_duration, help="Time limit of each node: 90, 30m, 2h. (default: no limit)"),
]
RetriesOption = Annotated[
    int, typer.Option("--retries", min=0, max=9, metavar="N", help="Retries of a node that fails for a reason which may pass.")
]
BackendOption = Annotated[str, typer.Option("--backend", metavar="NAME", envvar="WASP_BACKEND", help="Workers: loky (local), dask or ray.")]
SchedulerOption = Annotated[
    str | None, option("--scheduler", metavar="URL", envvar="WASP_SCHEDULER", help="Address of the dask scheduler or ray cluster.")
]
SetOption = Annotated[
    list[str] | None,
    option("--set", metavar="KEY=VALUE", help="Override a value of the spec (repeatable).", autocompletion=complete.settings),
]
LimitOption = Annotated[
    int | None,
    option("--limit", min=1, metavar="N", help="Only the first N episodes of each cell: a look before the whole, which computes the rest."),
]
SelectOption = Annotated[
    list[str] | None,
    option(
        "--select",
        metavar="FIELD=VALUE,...",
        help="Only these cells: 'task=race1,method=wasp|ida'; 'stage=world_model' selects training nodes (repeatable).",
    ),
]
ReuseOption = Annotated[
    str | None,
    option(
        "--reuse",
        metavar="none|published|DIR",
        help="Published results to use instead of computing: none, results/published, or a folder. (default: what the spec says)",
    ),
]
DryRunOption = Annotated[bool, flag("--dry-run", help="Show the plan, as wasp plan does, and run nothing.")]
FailedOption = Annotated[bool, flag("--failed", help="Only nodes that failed before, and nodes that wait for them.")]
JsonOption = Annotated[bool, flag("--json", help="Print JSON.")]


def results_folder(argument: Path | None, option: Path) -> Path:
    """Return the results folder, which a command takes as its argument or as `--results`.

    Raises:
        UsageError: both name one, and not the same.
    """
    from wasp_cli.errors import UsageError

    if argument is not None and option not in (argument, Path("results")):
        raise UsageError(f"two results folders: '{argument}' and --results '{option}'", "name one of them")
    return option if argument is None else argument


def expected_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Show an expected error as one message and end with its exit code; everything else is a bug and keeps its traceback.

    Expected are also the refusals of the system: a full disk, a folder without permission, a broken pipe.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        from wasp_cli.errors import WaspError

        try:
            end_in_order()
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

    # Help is the docstring, and its paragraphs are wrapped to the terminal, not to the source.
    wrapped.__doc__ = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(command.__doc__ or ""))
    return wrapped


def print_json(value: Any) -> None:
    """Print a value as JSON."""
    import json

    json.dump(value, sys.stdout, indent=1)
    sys.stdout.write("\n")
