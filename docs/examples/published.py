"""Count what of each shipped spec is published, and write it where `wasp --version` reads it.

python docs/examples/published.py --write

A spec of somebody else's environment is planned where that environment is installed; where it is
not, the count that was written last stays.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from wasp_cli.errors import WaspError
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.spec.shipped import (
    CONTENTS,
    Contents,
    published_contents,
    shipped_names,
    spec_path,
)
from wasp_cli.store.artifact import stored_keys
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
SPECS = ROOT / "specs"
PUBLISHED = ROOT / "results" / "published"


def spec_files() -> dict[str, Path]:
    """Return every shipped spec by the name that `wasp run` takes."""
    return {name: spec_path(Path(name), SPECS) for name in shipped_names()}


def published_cells(spec: Path) -> int:
    """Return how many cells of a spec `wasp run` takes from the published rows.

    Raises WaspError where the spec cannot be planned, such as without its environment.
    """
    grid = lay_out_over(load(spec).spec, Layout(Path("absent")), str(PUBLISHED))
    return len({node.key for _, node in grid.cells if node.key in grid.reused})


def all_published_cells() -> int:
    """Return how many cells are published, also those that no shipped spec asks for."""
    return len(stored_keys(Layout(PUBLISHED), "evaluate"))


def count() -> Contents:
    """Return the published cells of every spec that has any, and of all of them together."""
    before = published_contents()
    specs = {}
    for name, path in spec_files().items():
        try:
            found = published_cells(path)
        except WaspError:
            found = before.specs.get(name, 0)
        if found:
            specs[name] = found
    return Contents(cells=all_published_cells(), specs=specs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", action="store_true", help=f"write {CONTENTS}")
    asked = parser.parse_args()
    contents = count()
    text = json.dumps({"cells": contents.cells, "specs": contents.specs}, indent=2) + "\n"
    print(text, end="")
    if asked.write:
        (PUBLISHED / CONTENTS).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
