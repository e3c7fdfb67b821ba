"""`wasp init` and `wasp schema`: what helps to write a spec."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from wasp_cli.cli.command import command
from wasp_cli.cli.options import print_json
from wasp_cli.cli.parameters import argument, parse_folder
from wasp_cli.console import say
from wasp_cli.spec.shipped import copy_specs


@command("wasp init", "wasp init experiments/specs")
def init(
    folder: Annotated[Path, argument("DIR", "Where to.", parser=parse_folder)] = Path("specs"),
) -> None:
    """Copy the specs that come with wasp, to edit them.

    Files that are there stay as they are.
    """
    written, kept = copy_specs(folder)
    say(
        *(f"{path}: written" for path in written),
        *(f"{path}: is there, not changed" for path in kept),
    )


@command("wasp schema > specs/wasp.schema.json")
def schema() -> None:
    """Print the JSON Schema of specs, for editors.

    It is for completion and checks, with the names of installed plugins. The first line of a spec
    names it: `# yaml-language-server: $schema=wasp.schema.json`.
    """
    from wasp_cli.spec.schema import spec_schema

    print_json(spec_schema())
