"""How a command declares a parameter, and what it takes for a folder or a duration."""

from __future__ import annotations

import functools
import os
import re
from pathlib import Path
from typing import Any

import typer

from wasp_cli.cli.completion import Completion


def parse_folder(value: str | Path) -> Path:
    """Return a folder as it was typed. Raises typer.BadParameter if its name is empty, or is not
    valid UTF-8, which no report can hold.
    """
    # An empty name comes from an unset variable of a script; Path("") is the current folder.
    if not str(value).strip():
        raise typer.BadParameter("the name of the folder is empty")
    try:
        place = os.path.abspath(value)
    except OSError as error:
        raise typer.BadParameter(
            "the current folder is not there any more; change to another one"
        ) from error
    if os.fsencode(place).decode(errors="replace") != place:
        raise typer.BadParameter(f"{place!r} has bytes that are not UTF-8; rename the folder")
    return Path(value)


LONGEST = 1e8  # seconds of a duration: three years, which every clock can add


def parse_duration(text: str | float) -> float:
    """Return the seconds of a duration as it is typed: `90`, `90s`, `30m`, `2h`."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([smh]?)\s*", str(text))
    seconds = 0.0
    if match is not None:
        seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]
    if not 0 < seconds < LONGEST:
        raise typer.BadParameter(
            f"invalid duration '{text}'; write seconds (90), minutes (30m) or hours (2h)"
        )
    return seconds


def option(metavar: str, text: str, *names: str, among: Completion = None, **more: Any) -> Any:
    """Declare an option that takes a value. Without names it has that of its parameter; a
    default that the text explains is not shown.
    """
    return typer.Option(
        *names,
        metavar=metavar,
        help=text,
        show_default="(default: " not in text,
        autocompletion=among,
        **more,
    )


def argument(metavar: str, text: str, among: Completion = None, **more: Any) -> Any:
    """Declare an argument; a default that the text explains is not shown."""
    return typer.Argument(
        metavar=metavar,
        help=text,
        show_default="(default: " not in text,
        autocompletion=among,
        **more,
    )


def flag(name: str, text: str, *names: str, **more: Any) -> Any:
    """Declare an option without a value, or one with `--no-`."""
    return typer.Option(name, *names, help=text, **more)


directory = functools.partial(option, "DIR", parser=parse_folder)
