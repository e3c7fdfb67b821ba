"""Two runs side by side, cell by cell: the same rows, or a difference, whether it is more than
noise (`compare.paired`), and where it comes from (`compare.causes`).

A cell is what its identity says: task, method, variant, operator, value and seed; of a severity
that was chosen (`auto`), the value is what was chosen. One key on both sides means one
configuration, one code and one upstream, so the same rows but for what a machine may move; they are
read all the same. Differences are second minus first, over the worlds that both have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from wasp_cli.cells.asked import Asked, asked_of
from wasp_cli.cells.read import odd_tables_refused, rows_of
from wasp_cli.cells.runs import RunRecord, last_runs, results_of
from wasp_cli.cells.table import CellTable
from wasp_cli.compare.causes import Causes
from wasp_cli.compare.paired import MEASURES, Paired, corrected, paired_episodes
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError
from wasp_cli.report.bootstrap import Estimate, difference_of
from wasp_cli.report.stats import read_frame, row_of
from wasp_cli.report.summarize import absence_of
from wasp_cli.store.tables import CellIdentity, same_rows

LEVEL = 0.05
"""The largest p-value that counts as more than noise."""

State = Literal["same", "same rows", "differs", "only first", "only second", "not compared"]


@dataclass(frozen=True)
class ComparedCell:
    """A cell that at least one of the two runs asks for, and how its rows compare."""

    label: str
    identity: CellIdentity
    state: State
    keys: tuple[str | None, str | None]
    reason: str = ""  # why it is not compared
    paired: Paired | None = None  # of one that differs
    # by measure, corrected for measures and cells
    p: Mapping[str, float] = field(default_factory=dict)
    causes: tuple[str, ...] = ()

    @property
    def beyond(self) -> tuple[str, ...]:
        """The measures that differ by more than noise: p at most LEVEL."""
        return tuple(name for name, p in self.p.items() if p <= LEVEL)


@dataclass(frozen=True)
class Summary:
    """An assistant on a task, over the cells of which both runs have rows."""

    task: str
    method: str
    variant: str
    cells: int
    differing: int
    estimates: Mapping[str, Estimate | None]  # by measure


@dataclass(frozen=True)
class Compared:
    """Two runs beside each other."""

    first: Asked
    second: Asked
    cells: tuple[ComparedCell, ...]
    summary: tuple[Summary, ...]

    def having(self, *states: State) -> list[ComparedCell]:
        """Return the cells in some of the states, as the runs list them."""
        return [cell for cell in self.cells if cell.state in states]

    @property
    def beyond(self) -> list[ComparedCell]:
        """The cells that differ by more than noise in some measure."""
        return [cell for cell in self.cells if cell.beyond]

    @property
    def alike(self) -> bool:
        """Whether every cell was compared, and none differs by more than noise."""
        unknown = self.having("only first", "only second", "not compared")
        return not (self.beyond or unknown or self.first.absent or self.second.absent)

    @property
    def causes(self) -> list[tuple[str, int]]:
        """What differs behind the cells, each with the number of cells, most first."""
        return Counter(cause for cell in self.cells for cause in cell.causes).most_common()


def pairs(
    first: Path,
    second: Path,
    spec: str | None = None,
    spec_a: str | None = None,
    spec_b: str | None = None,
) -> list[tuple[Asked, Asked]]:
    """Return the pairs of runs to compare: two named specs, or every spec that has run in both
    folders.

    Args:
        first: a results folder.
        second: another one, or the same.
        spec: the name of a spec that has run in both.
        spec_a: that of a spec in the first, where it has another name in the second.
        spec_b: its name in the second.

    Raises:
        UsageError: the names exclude each other, a folder cannot be read, or nothing has run in
            both.
        UnknownName: a spec has not run there.
    """
    if (spec_a is None) != (spec_b is None) or (spec is not None and spec_a is not None):
        what = "--spec-a and --spec-b need each other, and exclude --spec"
        raise UsageError(what, "wasp compare A B --spec-a mine --spec-b other")
    try:
        before = last_runs(results_of(first)).runs
        after = last_runs(results_of(second)).runs
        name_a = spec if spec_a is None else spec_a
        name_b = spec if spec_b is None else spec_b
        if name_a is not None and name_b is not None:
            return [(_run_of(before, name_a, first), _run_of(after, name_b, second))]
        both = [name for name in before if name in after]
        if not both:
            which = "; ".join(
                f"'{folder}' has {', '.join(runs) or 'none'}"
                for folder, runs in ((first, before), (second, after))
            )
            raise UsageError(
                f"no spec has run in both folders: {which}",
                "choose one of each with --spec-a and --spec-b",
            )
        return [(asked_of(before[name]), asked_of(after[name])) for name in both]
    except (StoreError, ArtifactError) as error:
        raise UsageError(error.message, error.hint) from error


def _run_of(runs: Mapping[str, RunRecord], spec: str, folder: Path) -> Asked:
    """The last run of a spec."""
    if spec not in runs:
        raise UnknownName("spec", spec, runs, f"no spec '{spec}' has run in '{folder}'")
    return asked_of(runs[spec])


def compare(first: Asked, second: Asked) -> Compared:
    """Return two runs beside each other: every cell that one of them asks for, with paired
    differences and p-values that are corrected for the number of cells.
    """
    sides = [_Read(first), _Read(second)]
    causes = Causes(first.layout, second.layout)
    identities = dict.fromkeys((*sides[0].asked, *sides[1].asked))
    cells = [_cell(identity, sides[0], sides[1], causes) for identity in identities]
    tested = [(cell, cell.paired) for cell in cells if cell.paired is not None]
    p = corrected(
        [{name: each.p for name, each in paired.differences.items()} for _, paired in tested]
    )
    by_identity = {cell.identity: numbers for (cell, _), numbers in zip(tested, p, strict=True)}
    cells = [replace(cell, p=by_identity.get(cell.identity, {})) for cell in cells]
    return Compared(first, second, tuple(cells), tuple(_summary(cells, *sides)))


class _Read:
    """The cells of one of the two runs."""

    def __init__(self, side: Asked) -> None:
        self.layout = side.layout
        frame = read_frame(side.layout, side.cells, absence_of(side).by_key)
        self.asked = {cell.identity: cell for cell in side.cells}
        self.table = frame.cells
        self.places = {cell.identity: place for place, cell in enumerate(frame.cells)}
        self.reasons = {gap.cell.identity: gap.reason for gap in frame.missing}

    def key(self, identity: CellIdentity) -> str | None:
        """Return the key of a cell; None where this side does not ask for it."""
        cell = self.asked.get(identity)
        return None if cell is None else cell.key

    def cells(self, identities: Sequence[CellIdentity]) -> CellTable:
        """Return some of the cells with rows, in that order."""
        return self.table.choose([self.places[identity] for identity in identities])


def _cell(identity: CellIdentity, first: _Read, second: _Read, causes: Causes) -> ComparedCell:
    before = first.key(identity)
    after = second.key(identity)
    keys = (before, after)
    cell = first.asked.get(identity) or second.asked[identity]
    if before is None:
        return ComparedCell(cell.title, identity, "only second", keys)
    if after is None:
        return ComparedCell(cell.title, identity, "only first", keys)

    # What cannot be read is not compared.
    reasons = [
        f"{which}: {side.reasons[identity]}"
        for which, side in (("first", first), ("second", second))
        if identity in side.reasons
    ]
    same = False
    if not reasons:
        try:
            paths = (
                rows_of(first.layout, first.asked[identity]),
                rows_of(second.layout, second.asked[identity]),
            )
            with odd_tables_refused(paths[0]), odd_tables_refused(paths[1]):
                same = same_rows(*paths)
        except (StoreError, OSError) as error:
            reasons = [str(error)]
    if reasons:
        return ComparedCell(cell.title, identity, "not compared", keys, reason="; ".join(reasons))

    if same and before == after:
        return ComparedCell(cell.title, identity, "same", keys)
    why = causes.of("evaluate", before, after)
    if same:
        return ComparedCell(cell.title, identity, "same rows", keys, causes=why)
    paired = paired_episodes(first.cells([identity]), second.cells([identity]))
    if paired is None:
        return ComparedCell(cell.title, identity, "not compared", keys, reason="no world in common")
    return ComparedCell(cell.title, identity, "differs", keys, paired=paired, causes=why)


def _summary(cells: Sequence[ComparedCell], first: _Read, second: _Read) -> Iterator[Summary]:
    """The assistants of which both sides have cells, those without any difference too."""
    rows: dict[tuple[str, str, str], list[ComparedCell]] = {}
    for cell in cells:
        if cell.state in ("same", "same rows", "differs"):
            rows.setdefault(row_of(cell.identity), []).append(cell)
    for (task, method, variant), own in rows.items():
        identities = [cell.identity for cell in own]
        before = first.cells(identities)
        after = second.cells(identities)
        estimates = {name: difference_of(after, before, name) for name in MEASURES}
        differing = sum(cell.state == "differs" for cell in own)
        yield Summary(task, method, variant, len(own), differing, estimates)
