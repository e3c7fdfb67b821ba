"""Who takes part in a spec, which cells are whose and in which order, and what was driven."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from wasp_cli.drive.desk import END
from wasp_cli.errors import UsageError
from wasp_cli.operators.registry import PERSON
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.keys import canonical
from wasp_cli.plan.node import Cell, Node
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import Loaded
from wasp_cli.spec.model import Spec
from wasp_cli.spec.study import balanced_order
from wasp_cli.store.artifact import (
    read_manifest,
    stored_keys,
)
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import SESSION_FILE
from wasp_cli.store.records import read_record


def participants(spec: Spec) -> dict[int, str]:
    """Return the participants of a spec: number, and name in the spec."""
    return {int(value): name for name, value in spec.operators.get(PERSON, {}).items()}


def drivers(spec: Spec) -> dict[int, str]:
    """Return `participants`. Raises UsageError if there is none."""
    numbers = participants(spec)
    if numbers:
        return numbers
    raise UsageError(
        f"nobody drives in '{spec.name}'",
        "name participants in it: operators: {person: {p1: 1, p2: 2}}, with side_by_side: 1",
    )


def cells_of(grid: Grid, participant: int) -> list[tuple[Cell, Node]]:
    """Return the cells that a participant drives, each with its node."""
    return [
        (cell, node)
        for cell, node in grid.cells
        if cell.operator == PERSON and cell.value == participant
    ]


def ordered(cells: list[tuple[Cell, Node]], participant: int) -> list[tuple[Cell, Node]]:
    """Return the cells of a participant task by task; within a task, and for each seed, in the
    participant's row of a Williams square.
    """
    groups: dict[tuple[str, int], list[tuple[Cell, Node]]] = {}
    for cell, node in cells:
        groups.setdefault((cell.task, cell.seed), []).append((cell, node))
    return [
        group[place]
        for group in groups.values()
        for place in balanced_order(len(group), participant - 1)
    ]


def driven_by(manifest: Mapping[str, Any], participant: int | None) -> bool:
    """Return whether a cell was driven by a participant, or with None by any person."""
    axes = manifest.get("axes", {})
    return axes.get("operator") == PERSON and participant in (None, axes.get("value"))


def driven(layout: Layout, participant: int | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield key and manifest of what a participant, or anybody, drove."""
    for key in sorted(stored_keys(layout, "evaluate")):
        manifest = read_manifest(layout, "evaluate", key)
        if driven_by(manifest, participant):
            yield key, manifest


def driven_tasks(results: Path, participant: int) -> list[str]:
    """Return the tasks of which a participant has driven anything. Raises UsageError if there are
    none.
    """
    tasks = {
        str(manifest.get("task")) for _, manifest in driven(Layout(results.absolute()), participant)
    }
    if not tasks:
        raise UsageError(
            f"participant {participant} has driven nothing in '{results}'",
            f"wasp drive TASK --participant {participant}",
        )
    return sorted(tasks)


def free_session(layout: Layout, of: Callable[[int], Loaded]) -> int:
    """Return the first number of a session whose cells nobody has driven to the end yet, so that a
    session that ended early goes on.

    Args:
        of: returns the spec of a session, by its number.
    """
    # By cell, how many episodes were driven; a sitting that did not end early counts as infinite,
    # so that it is not continued if more episodes are asked for.
    most: dict[str, float] = {}
    for key, manifest in driven(layout):
        session = read_record(layout.artifact("evaluate", key) / SESSION_FILE) or {}
        episodes = manifest["config"]["episodes"]
        cuts = session.get("cut", ())
        early = any(cut["why"] == END and cut["before_episode"] == episodes for cut in cuts)
        cell = canonical([manifest["task"], manifest["seed"], manifest["axes"]])
        most[cell] = max(most.get(cell, 0), episodes if early else math.inf)

    def is_free(node: Node) -> bool:
        cell = canonical([node.task, node.seed, node.axes])
        episodes: int = node.config["episodes"]
        return most.get(cell, 0) < episodes

    number = 0
    while True:
        cells = lay_out_over(of(number).spec, layout, None).cells
        if all(is_free(node) for _, node in cells):
            return number
        number += 1
