"""What a report is about: the table of its cells, those that are missing, and the rows of its
tables.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.judged import Judged, read_judged, with_judged
from wasp_cli.cells.read import NOTHING, Missing, read_cells
from wasp_cli.cells.table import CellTable
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

Assistant = tuple[str, str, str]  # task, method and ablation: a row of a table


@dataclass(frozen=True, eq=False)
class Group:
    """A row of a table: an assistant on a task."""

    task: str
    method: str
    variant: str
    cells: CellTable
    absent: int  # cells that are missing

    @property
    def assistant(self) -> Assistant:
        """Task, method and ablation, which no other row has."""
        return self.task, self.method, self.variant

    @property
    def complete(self) -> bool:
        """Whether all its cells are there."""
        return self.absent == 0

    def of_operator(self, operator: str) -> CellTable:
        """Return the cells under one operator."""
        return self.cells.where(lambda cell: cell.operator == operator)


@dataclass(frozen=True, eq=False)
class Frame:
    """The cells of a report."""

    cells: CellTable
    missing: tuple[Missing, ...] = ()
    order: tuple[RecordedCell, ...] = ()  # all wanted cells, as they were asked for
    # the branched interventions of cells, by their keys
    judged: Mapping[str, Judged] = field(default_factory=dict)
    # the cells with rows whose interventions should have been branched, and were not
    unbranched: tuple[Missing, ...] = ()
    # what is not installed here and whose cells are left out, each as a sentence
    absent: tuple[str, ...] = ()

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """The rows of its tables, also those without any readable cell: by task, then in the order
        of the wanted cells.
        """
        places: dict[Assistant, list[int]] = {row_of(cell): [] for cell in self.order}
        for place, cell in enumerate(self.cells):
            places.setdefault(row_of(cell), []).append(place)
        absent = Counter(row_of(gap.cell) for gap in self.missing)
        rows = [Group(*row, self.cells.choose(own), absent[row]) for row, own in places.items()]
        tasks = list(dict.fromkeys(group.task for group in rows))
        methods = list(dict.fromkeys(group.method for group in rows))
        rows.sort(key=lambda group: (tasks.index(group.task), methods.index(group.method)))
        return tuple(rows)


def row_of(cell: CellIdentity) -> Assistant:
    """Return task, method and ablation of a cell: the row of a table that it belongs to."""
    return cell.task, cell.method, cell.variant


def read_frame(
    layout: Layout, cells: Iterable[RecordedCell], absent: Mapping[str, str] = NOTHING
) -> Frame:
    """Return the cells that can be read, and the others as missing.

    Args:
        layout: of the results folder.
        cells: the cells that were asked for.
        absent: by key, why an artifact is not there, if that is known.
    """
    order = tuple(cells)
    found = read_cells(layout, order, absent)
    return Frame(found.table, found.missing, order)


def with_branches(layout: Layout, frame: Frame, absent: Mapping[str, str] = NOTHING) -> Frame:
    """Return a frame with the counterfactual branches of its cells, whose numbers are further
    columns; `unbranched` names the cells that should have branches.
    """
    found = read_judged(layout, frame.cells, absent)
    if not found.judged:
        return replace(frame, unbranched=found.missing)
    cells = with_judged(frame.cells, found.judged)
    return replace(frame, cells=cells, judged=found.judged, unbranched=found.missing)
