"""Two runs side by side, cell by cell: the same rows, or a difference, and whether it is more than noise.

A cell is what its identity says: task, method, variant, operator, value and seed. One key on both sides means one configuration, one code
and one upstream, so the same rows but for what a machine may move; they are read all the same. Differences are second minus first.
"""

from __future__ import annotations

import filecmp
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from wasp_cli.compare.causes import Causes
from wasp_cli.compare.paired import LEVEL, MEASURES, Paired, corrected, paired_episodes
from wasp_cli.errors import StoreError
from wasp_cli.plan.node import Cell
from wasp_cli.report.stats.bootstrap import Estimate, difference_of
from wasp_cli.report.stats.frame import CellNumbers, Wanted, odd_tables_refused, read_frame
from wasp_cli.report.summarize import wanted_cells
from wasp_cli.spec.model import Spec
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, same_rows

State = Literal["same", "same rows", "differs", "only first", "only second", "not compared"]


@dataclass(frozen=True)
class Side:
    """One of two runs."""

    layout: Layout
    run_id: str
    spec: Spec
    cells: Sequence[tuple[Cell, str]]
    """Each with the key of its evaluation."""


@dataclass(frozen=True)
class ComparedCell:
    """A cell of either side."""

    label: str
    identity: CellIdentity
    state: State
    keys: tuple[str | None, str | None]
    reason: str = ""
    """Why it is not compared."""
    paired: Paired | None = None
    """Of one that differs."""
    p: Mapping[str, float] = field(default_factory=dict)
    """By measure, corrected for measures and cells."""
    causes: tuple[str, ...] = ()

    @property
    def beyond(self) -> tuple[str, ...]:
        """The measures that differ by more than noise."""
        return tuple(name for name, p in self.p.items() if p <= LEVEL)


@dataclass(frozen=True)
class Summary:
    """An assistant on a task over all cells that both sides have."""

    task: str
    method: str
    variant: str
    cells: int
    differing: int
    estimates: Mapping[str, Estimate | None]
    """By measure."""


@dataclass(frozen=True)
class Compared:
    """Two runs side by side."""

    first: Side
    second: Side
    cells: tuple[ComparedCell, ...]
    summary: tuple[Summary, ...]

    def having(self, *states: State) -> list[ComparedCell]:
        """Return the cells in one of the given states."""
        return [cell for cell in self.cells if cell.state in states]

    @property
    def beyond(self) -> list[ComparedCell]:
        """The cells that differ by more than noise."""
        return [cell for cell in self.cells if cell.beyond]

    @property
    def alike(self) -> bool:
        """Whether both have the same cells, each readable and without a difference beyond noise."""
        return not self.beyond and not self.having("only first", "only second", "not compared")

    @property
    def causes(self) -> list[tuple[str, int]]:
        """What differs, and in how many cells."""
        return Counter(cause for cell in self.cells for cause in cell.causes).most_common()


def compare(first: Side, second: Side) -> Compared:
    """Compare two runs; nothing is executed and nothing is written."""
    sides = [_Read(first), _Read(second)]
    causes = Causes(first.layout, second.layout)
    identities = dict.fromkeys((*sides[0].keys, *sides[1].keys))
    cells = [_cell(identity, sides[0], sides[1], causes) for identity in identities]
    found = [(cell, cell.paired) for cell in cells if cell.paired is not None]
    p = corrected([{name: each.p for name, each in paired.differences.items()} for _, paired in found])
    by_identity = {cell.identity: numbers for (cell, _), numbers in zip(found, p, strict=True)}
    cells = [replace(cell, p=by_identity.get(cell.identity, {})) for cell in cells]
    return Compared(first, second, tuple(cells), tuple(_summary(cells, *sides)))


class _Read:
    """What can be read of a side, by the identity of the cell."""

    def __init__(self, side: Side) -> None:
        self.layout = side.layout
        wanted, _ = wanted_cells(side.layout, side.spec, side.cells)
        frame = read_frame(wanted)
        self.wanted: dict[CellIdentity, Wanted] = {each.identity: each for each in wanted}
        self.keys = {each.identity: key for each, (_, key) in zip(wanted, side.cells, strict=True)}
        self.numbers: dict[CellIdentity, CellNumbers] = {cell.identity: cell for cell in frame.cells}
        self.reasons = {gap.identity: gap.reason for gap in frame.missing}


def _cell(identity: CellIdentity, first: _Read, second: _Read, causes: Causes) -> ComparedCell:
    keys = first.keys.get(identity), second.keys.get(identity)
    label = (first.wanted.get(identity) or second.wanted[identity]).label
    if keys[0] is None or keys[1] is None:
        return ComparedCell(label, identity, "only first" if keys[1] is None else "only second", keys)
    reasons = [f"{which}: {side.reasons[identity]}" for which, side in (("first", first), ("second", second)) if identity in side.reasons]
    paths = first.wanted[identity].path, second.wanted[identity].path
    if not reasons:
        try:
            with odd_tables_refused(paths[0]), odd_tables_refused(paths[1]):
                # Copies are the common case, and comparing bytes is cheaper than comparing rows.
                same = filecmp.cmp(*paths, shallow=False) or same_rows(*paths)
        except (StoreError, OSError) as error:
            reasons = [str(error)]
    if reasons:
        return ComparedCell(label, identity, "not compared", keys, reason="; ".join(reasons))
    if same:
        why = () if keys[0] == keys[1] else causes.of("evaluate", keys[0], keys[1])
        return ComparedCell(label, identity, "same" if keys[0] == keys[1] else "same rows", keys, causes=why)
    found = paired_episodes(first.numbers[identity], second.numbers[identity])
    return ComparedCell(label, identity, "differs", keys, paired=found, causes=causes.of("evaluate", keys[0], keys[1]))


def _summary(cells: Sequence[ComparedCell], first: _Read, second: _Read) -> Iterator[Summary]:
    """The assistants of which both sides have cells, those without any difference too."""
    rows: dict[tuple[str, str, str], list[ComparedCell]] = {}
    for cell in cells:
        if cell.state in ("same", "same rows", "differs"):
            rows.setdefault((cell.identity.task, cell.identity.method, cell.identity.assistant_variant), []).append(cell)
    for (task, method, variant), found in rows.items():
        before, after = ([side.numbers[cell.identity] for cell in found] for side in (first, second))
        estimates = {name: difference_of(after, before, name) for name in MEASURES}
        yield Summary(task, method, variant, len(found), sum(cell.state == "differs" for cell in found), estimates)
