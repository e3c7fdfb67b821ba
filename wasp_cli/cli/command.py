"""Turns functions into commands of `wasp`: their options, their help, and what happens with
expected errors.
"""

from __future__ import annotations

import functools
import inspect
import os
import re
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from wasp_cli.console import INTERRUPTED, end_in_order, report_error, silence
from wasp_cli.errors import WaspError, refusal

PIPE_CLOSED = 141
# all commands, as `wasp --help` lists them: each with the first sentence of its docstring
GROUPS = {
    "Start": ("run", "report", "view", "drive"),
    "Prepare": ("list", "draw", "try", "init", "check", "schema", "clone", "plan"),
    "Compare": ("sweep", "ablate", "compare", "submit", "leaderboard"),
    "Look into": ("status", "logs", "show", "explain", "replay", "note", "export"),
    "Maintain": ("publish", "verify", "gc", "doctor"),
}

Command = TypeVar("Command", bound=Callable[..., None])


class _Group(TyperGroup):
    """All commands, whose help fits on one screen; that of a command is Typer's."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args and not ctx.resilient_parsing:
            typer.echo(self.get_help(ctx))
            ctx.exit(2)
        return super().parse_args(ctx, args)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        from rich.console import Console
        from rich.table import Table

        table = Table.grid(padding=(0, 2, 0, 0))
        for style in ("dim", "bold cyan", ""):
            table.add_column(style=style, no_wrap=bool(style))
        for title, names in GROUPS.items():
            table.add_row()
            for name in names:
                table.add_row(
                    title if name == names[0] else "",
                    name,
                    self.commands[name].get_short_help_str(limit=1000),
                )
        options = ", ".join(name for parameter in self.get_params(ctx) for name in parameter.opts)
        console = Console(highlight=False)
        with console.capture() as shown:
            console.print(
                self.get_usage(ctx),
                f"\n{self.help}",
                table,
                f"\nOptions: {options}",
                sep="\n",
                markup=False,
            )
        formatter.write(shown.get())


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:
        params: list[Any] = super().get_params(ctx)
        for param in params:
            if getattr(param, "is_flag", False) and param.metavar is None:
                param.metavar = ""
        return params


HELP = """\
Run experiments in shared autonomy. A spec says which; results go to results/.
Start here: wasp run quickstart, then: wasp report results/
Drive: wasp drive race1. Check: wasp verify. Your own: docs/extending.md"""
app = typer.Typer(
    name="wasp", cls=_Group, help=HELP, rich_markup_mode="rich", pretty_exceptions_enable=False
)


def command(
    *examples: str, codes: str = "", name: str | None = None
) -> Callable[[Command], Command]:
    """Return a decorator that makes a function a command: its docstring is the help, and its
    parameters are the options.

    A parameter whose type is a dataclass stands for its fields, so that commands share options.

    Args:
        examples: calls, for the end of the help.
        codes: what exit codes mean, for the end of the help.
        name: of the command; None: that of the function.
    """
    shown = "   ·   ".join(f"[bold]{example}[/]" for example in examples)
    epilog = f"{shown}\n\nExit codes: {codes}." if codes else shown

    def registered(function: Command) -> Command:
        app.command(name, cls=_Command, epilog=epilog)(_expecting_errors(_flat(function)))
        return function

    return registered


def _flat(function: Callable[..., None]) -> Callable[..., None]:
    """Take the fields of parameters that are dataclasses as parameters of their own."""
    hints = get_type_hints(function, include_extras=True)
    shared: dict[str, Any] = {name: kind for name, kind in hints.items() if is_dataclass(kind)}
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(function).parameters.values():
        group = shared.get(parameter.name)
        types = get_type_hints(group, include_extras=True) if group else hints
        for option in inspect.signature(group).parameters.values() if group else [parameter]:
            parameters.append(
                option.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=types[option.name])
            )

    @functools.wraps(function)
    def flat(**values: Any) -> None:
        for name, kind in shared.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        function(**values)

    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Help is the docstring, and its paragraphs are wrapped to the terminal, not to the source.
    flat.__doc__ = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.cleandoc(function.__doc__ or ""))
    return flat


def _expecting_errors(function: Callable[..., None]) -> Callable[..., None]:
    """Print an expected error as one message, and end with its exit code. Any other error is a bug
    and keeps its traceback.

    Errors of the operating system are expected too: a full disk, missing permissions, a broken
    pipe.
    """

    @functools.wraps(function)
    def wrapped(**values: Any) -> None:
        try:
            end_in_order()
            function(**values)
            sys.stdout.flush()
        except (WaspError, OSError) as error:
            if isinstance(error, OSError):
                silence(sys.stdout)  # what it still holds would raise again at the end
            if os.environ.get("WASP_DEBUG"):
                raise
            if isinstance(error, BrokenPipeError):
                raise typer.Exit(PIPE_CLOSED) from None
            expected = error if isinstance(error, WaspError) else refusal(error)
            report_error(expected)
            raise typer.Exit(expected.exit_code) from None
        except (KeyboardInterrupt, typer.Abort):  # the latter where a question was asked
            if os.environ.get("WASP_DEBUG"):
                raise
            print("interrupted", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None

    return wrapped
