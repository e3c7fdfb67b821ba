"""The `wasp` program. Each command parses, makes one call and returns an exit code; heavy imports are inside the commands."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from wasp_cli import __version__
from wasp_cli.cli.doctor import doctor_app
from wasp_cli.cli.drive import drive_app
from wasp_cli.cli.inspect import inspect_app
from wasp_cli.cli.options import flag
from wasp_cli.cli.report import report_app
from wasp_cli.cli.run import run_app
from wasp_cli.cli.spec import spec_app, tasks_app
from wasp_cli.cli.store import store_app
from wasp_cli.cli.view import view_app


class _Plain:
    """A command whose help shows no type behind the switches that typer adds itself, such as --help."""

    def get_params(self, ctx: Any) -> list[Any]:
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False) and param.metavar is None:
                param.metavar = ""
        return params


class _Command(_Plain, TyperCommand):
    pass


class _Group(_Plain, TyperGroup):
    pass


app = typer.Typer(
    name="wasp",
    cls=_Group,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help="Run experiments in shared autonomy: train models, evaluate assistants with impaired operators, compare them.\n\n"
    "A spec (a YAML file, or a name such as quickstart) says what to run. Results are kept in results/, and nothing is computed twice.",
    epilog="Start here:  [bold]wasp run quickstart[/]   ·   then:  [bold]wasp report results/[/]",
)
for group in (run_app, report_app, view_app, inspect_app, drive_app, spec_app, store_app):
    app.add_typer(group)
app.add_typer(tasks_app, name="tasks", cls=_Group, rich_help_panel="Specs and tasks")
app.add_typer(doctor_app)
for added in app.registered_groups:
    for command in added.typer_instance.registered_commands if added.typer_instance else ():
        command.cls = _Command


def _version(wanted: bool) -> None:
    if wanted:
        print(f"wasp {__version__}")
        raise typer.Exit


@app.callback()
def main_options(
    debug: Annotated[bool, flag("--debug", help="Show the traceback of expected errors too (or set WASP_DEBUG=1).")] = False,
    version: Annotated[bool, flag("--version", callback=_version, is_eager=True, help="Print the version and exit.")] = False,
) -> None:
    """Take the options of every command."""
    if debug:
        os.environ["WASP_DEBUG"] = "1"


def main() -> None:
    """Run the program."""
    os.environ["PYTHONSAFEPATH"] = "1"  # no process of ours imports from the working directory, which may be somebody's results
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # an ASCII terminal shows ? where it has no character
            stream.reconfigure(errors="replace")
    app([*(["--debug"] if "--debug" in sys.argv[1:] else []), *(word for word in sys.argv[1:] if word != "--debug")])
