"""What a run was asked for: its spec as far as it is known here, with the cells and the trained
parts that reports are about.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from wasp_cli.cells.cell import BRANCHES, RecordedCell, recorded_cell
from wasp_cli.cells.runs import AGAIN, RunRecord
from wasp_cli.errors import ArtifactError
from wasp_cli.methods.registry import METHODS
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.plan.grid import Grid
from wasp_cli.plan.node import Part
from wasp_cli.spec.model import Spec, spec_type
from wasp_cli.spec.names import RECORDED
from wasp_cli.stages.registry import STAGES
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.plain import read_plain

REQUIRED = ("name", "tasks", "seeds")  # without one of them there is nothing to report
MOST_UNKNOWN = 200  # things that a spec may have that are not known here: a folder may be hostile


@dataclass(frozen=True)
class Asked:
    """What a run was asked for, of what is installed here."""

    layout: Layout
    run_id: str
    spec: Spec
    cells: tuple[RecordedCell, ...]
    parts: tuple[tuple[Part, str], ...]  # the trained ones, each with the key of its artifact
    # what its record has that this version does not know, each as a sentence; it stays in the
    # record, and is in no table
    unknown: tuple[str, ...] = ()
    # whose cells are left out, since it is not installed here, each as a sentence
    absent: tuple[str, ...] = ()

    @property
    def artifacts(self) -> list[tuple[str, str]]:
        """Kind and key of everything that it asked for: cells, then their branches, then what it
        trains.
        """
        cells = [(KIND, cell.key) for cell in self.cells]
        branches = [(BRANCHES, cell.branches) for cell in self.cells if cell.branches is not None]
        parts = [(part.kind, key) for part, key in self.parts]
        return [*cells, *branches, *parts]


def asked_of(run: RunRecord) -> Asked:
    """Return what a recorded run was asked for.

    Raises:
        ArtifactError: its record is damaged, or of another version.
    """
    spec, unknown = _read_spec(run)
    parts = [(part, key) for part, key in run.parts if part.kind in STAGES]
    here: list[RecordedCell] = []
    absent: Counter[str] = Counter()
    for cell in run.cells:
        if cell.method not in METHODS:
            absent[cell.method] += 1
        elif cell.operator not in OPERATORS and cell.operator != UNIMPAIRED:
            absent[cell.operator] += 1
        else:
            here.append(replace(cell, training_seed=spec.training_seed))
    return Asked(
        run.layout,
        run.run_id,
        spec,
        tuple(here),
        tuple(parts),
        tuple(unknown),
        tuple(_left_out(absent)),
    )


def asked_of_grid(layout: Layout, run_id: str, spec: Spec, grid: Grid) -> Asked:
    """Return what a spec asks for as it is laid out now, in the run of this name."""
    branches = {cell: node.key for cell, node in grid.branched}
    cells = [
        recorded_cell(layout, cell, node.key, spec.name, branches.get(cell), spec.training_seed)
        for cell, node in grid.cells
    ]
    parts = [(part, node.key) for part, node in grid.parts]
    return Asked(layout, run_id, spec, tuple(cells), tuple(parts))


def _left_out(absent: Counter[str]) -> Iterable[str]:
    for name, count in sorted(absent.items()):
        cells = "its cell is" if count == 1 else f"its {count} cells are"
        yield f"{name}: not installed here; {cells} left out."


def _read_spec(run: RunRecord) -> tuple[Spec, list[str]]:
    path = run.layout.within(run.layout.run(run.run_id)) / "spec.json"
    try:
        return _known_part(json.loads(read_plain(path)))
    except (OSError, ValueError) as error:  # a ValidationError is a ValueError
        why = str(error).partition("\n")[0]
        raise ArtifactError(f"cannot read the spec of run '{run.run_id}': {why}", AGAIN) from error


def _known_part(document: Any) -> tuple[Spec, list[str]]:
    """The spec without what is not known here (another version wrote it, or a plugin that is
    absent now), and what that was.
    """
    unknown: list[str] = []
    while True:
        try:
            spec = spec_type().model_validate_json(
                json.dumps(document), strict=True, context={RECORDED: True}
            )
        except ValidationError as error:
            name = _first_taken_out(document, error)
            if name is None or len(unknown) > MOST_UNKNOWN:
                raise
            unknown.append(
                f"The spec has `{name}`, which is not known here: an absent plugin's, or "
                "another version's."
            )
        else:
            return spec, unknown


def _first_taken_out(document: Any, error: ValidationError) -> str | None:
    """Take one of the things that are wrong out of a document; return its dotted name, or None
    where nothing may be taken out.
    """
    # One at a time: taking an entry out of a list moves those behind it.
    for problem in error.errors(include_url=False):
        name = _taken_out(document, problem["loc"])
        if name is not None:
            return name
    return None


def _taken_out(document: Any, loc: Sequence[str | int]) -> str | None:
    """Take the deepest thing out of a document that a place names; return its dotted name, or
    None where nothing may be taken out.
    """
    # The way down to it: each thing that holds the next one, and the name or place there.
    node: Any = document
    way: list[tuple[Any, Any]] = []
    for part in loc:
        in_mapping = isinstance(node, dict) and part in node
        in_list = isinstance(node, list) and isinstance(part, int) and part < len(node)
        if in_mapping or in_list:
            way.append((node, part))
            node = node[part]
    if not way or (len(way) == 1 and way[0][1] in REQUIRED):
        return None
    parent, name = way[-1]
    shown = ".".join(str(part) for _, part in way[:-1])
    value = parent.pop(name)
    if isinstance(parent, list):
        return f"{shown}: {value}"
    return f"{shown}.{name}" if shown else str(name)
