"""The runs that a report is about."""

from __future__ import annotations

from wasp_cli.errors import ArtifactError
from wasp_cli.store.artifact import read_record
from wasp_cli.store.layout import Layout


def last_runs(layout: Layout) -> tuple[dict[str, str], list[str]]:
    """The last run of each spec name, oldest first; and what is wrong with the runs whose plan does not read."""
    found: dict[str, str] = {}
    damaged: list[str] = []
    for path in sorted(layout.runs.glob("*/plan.json")):
        try:
            name = (read_record(path) or {}).get("spec")
        except ArtifactError as error:
            damaged.append(error.message)
            continue
        if not isinstance(name, str):
            damaged.append(f"'{path}' is damaged: it names no spec")
            continue
        found.pop(name, None)
        found[name] = path.parent.name
    return found, damaged
