"""Two runs side by side, cell by cell: the same rows, or a difference, whether it is more than
noise, and where it comes from.

A cell is what its identity says: task, method, variant, operator, value and seed; of a severity
that was chosen (`auto`), the value is what was chosen. One key on both
sides means one configuration, one code and one upstream, so the same rows but for what a machine
may move; they are read all the same. Differences are second minus first.

Episodes of the same world are pairs. Under the hypothesis that the two evaluations are alike, the
difference of every world could as well have the other sign, for all measures at once: the p-value
of a measure is the share of the 2^n flips (all of them up to EXACT worlds, else FLIPS draws) in
which the largest of all standardised differences reaches that of the measure (Westfall and Young
1993). So p-values are corrected for the number of measures already; `corrected` does the same for
the number of cells (Holm 1979). What counts as noise is chance over worlds, for the models of these
two evaluations.

Causes are found from the manifests alone, which may be untrusted; nothing is imported and no code
of today is looked at. Letters: n worlds (episodes), M measures, R flips.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.asked import Asked, asked_of
from wasp_cli.cells.read import odd_tables_refused, rows_of
from wasp_cli.cells.runs import last_runs, results_of
from wasp_cli.cells.table import CellTable
from wasp_cli.errors import ArtifactError, StoreError, UnknownName, UsageError
from wasp_cli.plan.reasons import changes_between, few
from wasp_cli.report.bootstrap import COVERAGE, SEED, Estimate, difference_of, drawn
from wasp_cli.report.node import mapping, upstream_of
from wasp_cli.report.stats import read_frame, row_of
from wasp_cli.report.summarize import absence_of
from wasp_cli.report.summary import Interval
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity, same_rows

MEASURES = ("return", "cost", "viol", "int_rate", "success")
EXACT = 13  # worlds up to which all flips are tried
FLIPS = 10_000
LEVEL = 0.05


@dataclass(frozen=True)
class Difference(Estimate):
    """A measure of one cell, after minus before, as a mean over episodes."""

    p: float  # corrected for the number of measures


@dataclass(frozen=True)
class Paired:
    """What the worlds that two evaluations share say of their difference."""

    differences: Mapping[str, Difference]  # by measure
    worlds: int  # n, those that both have
    episodes: tuple[int, int]
    least: float  # the smallest p-value that so many episodes can have


def paired_episodes(before: CellTable, after: CellTable) -> Paired | None:
    """Compare the episodes of two evaluations, each a table of one cell; None where they have no
    world in common.
    """
    common, left, right = np.intersect1d(before.worlds, after.worlds, return_indices=True)
    if not len(common):
        return None
    x = np.stack([before.episodes(name) for name in MEASURES], 1)
    y = np.stack([after.episodes(name) for name in MEASURES], 1)
    change = y[right] - x[left]  # [n, M]
    n = len(change)

    # Intervals of the mean change, over worlds.
    intervals: list[Interval | None] = [None] * len(MEASURES)
    if n > 1:
        resampled = drawn(n) @ change / n
        limits = np.quantile(resampled, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2], axis=0)
        intervals = [Interval(float(low), float(high), "world", n) for low, high in limits.T]

    # The largest of all standardised changes under every flip of signs.
    moved = change[np.any(change != 0, 1)]  # a world without any difference has no sign
    signs, exact = _signs(len(moved))
    # the same under every flip; 0 of a measure that never differs
    size = np.sqrt(np.square(moved).sum(0))
    flipped = _over(np.abs(signs @ moved), size)
    own = _over(np.abs(moved.sum(0)), size)
    reached = (flipped.max(1)[:, None] >= own * (1 - 1e-12)).sum(0)
    if exact:
        p = reached / len(signs)
        least = 2.0 ** (1 - len(moved)) if len(moved) else 1.0
    else:
        p = (reached + 1) / (FLIPS + 1)
        least = 1 / (FLIPS + 1)

    differences = {}
    means = change.mean(0).tolist()
    for name, mean, interval, of_measure in zip(
        MEASURES, means, intervals, p.tolist(), strict=True
    ):
        differences[name] = Difference(mean, interval, of_measure)
    return Paired(differences, n, (len(x), len(y)), least)


def _signs(worlds: int) -> tuple[NDArray[np.float64], bool]:
    """[R, worlds] the flips of signs, and whether these are all that there are."""
    if worlds <= EXACT:
        flips = (np.arange(2**worlds)[:, None] >> np.arange(worlds)) & 1
        return 1.0 - 2.0 * flips.astype(np.float64), True
    bits = np.random.PCG64(SEED).random_raw((FLIPS, worlds)) >> np.uint64(63)
    return 1.0 - 2.0 * bits.astype(np.float64), False


def _over(values: NDArray[np.float64], size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values [..., M] by the size of each measure; 0 where it has none."""
    quotient: NDArray[np.float64] = np.divide(
        values, size, out=np.zeros_like(values), where=size > 0
    )
    return quotient


def corrected(cells: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Correct the p-values of measures for the number of cells by Holm's steps: cells in the
    order of their smallest one.
    """
    order = sorted(range(len(cells)), key=lambda i: min(cells[i].values()))
    adjusted: list[dict[str, float]] = [{} for _ in cells]
    floor = 0.0
    for step, i in enumerate(order):
        adjusted[i] = {
            name: min(1.0, max(floor, (len(cells) - step) * p)) for name, p in cells[i].items()
        }
        floor = min(adjusted[i].values())
    return adjusted


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
    """
    if (spec_a is None) != (spec_b is None) or (spec is not None and spec_a is not None):
        what = "--spec-a and --spec-b need each other, and exclude --spec"
        raise UsageError(what, "wasp compare A B --spec-a mine --spec-b other")
    spec_a, spec_b = (spec, spec) if spec is not None else (spec_a, spec_b)
    try:
        layouts = [results_of(folder) for folder in (first, second)]
        runs = [last_runs(layout).runs for layout in layouts]
        for name, known, folder in ((spec_a, runs[0], first), (spec_b, runs[1], second)):
            if name is not None and name not in known:
                raise UnknownName("spec", name, known, f"no spec '{name}' has run in '{folder}'")
        names = (
            [(spec_a, spec_b)]
            if spec_a is not None and spec_b is not None
            else [(name, name) for name in runs[0] if name in runs[1]]
        )
        if not names:
            which = "; ".join(
                f"'{folder}' has {', '.join(known) or 'none'}"
                for folder, known in zip((first, second), runs, strict=True)
            )
            raise UsageError(
                f"no spec has run in both folders: {which}",
                "choose one of each with --spec-a and --spec-b",
            )
        return [(asked_of(runs[0][a]), asked_of(runs[1][b])) for a, b in names]
    except (StoreError, ArtifactError) as error:
        raise UsageError(error.message, error.hint) from error


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


# provenance that enters no key, and may move the last digits
MACHINE = ("processor", "platform", "python", "threads", "cuda")


class Causes:
    """Follows two artifacts upstream to where they begin to differ; every pair is looked at
    once.
    """

    def __init__(self, before: Layout, after: Layout) -> None:
        self._layouts = before, after
        self._known: dict[tuple[str, str, str], tuple[str, ...]] = {}

    def of(self, kind: str, before: str, after: str) -> tuple[str, ...]:
        """Say in words what differs between two artifacts that should be alike; of the same key
        only the machine can differ.
        """
        return tuple(
            dict.fromkeys(
                self._machine(kind, before)
                if before == after
                else self._follow(kind, before, after)
            )
        )

    def _follow(self, kind: str, before: str, after: str) -> tuple[str, ...]:
        place = (kind, before, after)
        if place not in self._known:
            self._known[place] = ()  # a circle, which none of ours has, adds nothing
            self._known[place] = tuple(dict.fromkeys(self._changes(kind, before, after)))
        return self._known[place]

    def _changes(self, kind: str, before: str, after: str) -> Iterator[str]:
        try:
            old, new = (
                read_manifest(layout, kind, key)
                for layout, key in zip(self._layouts, (before, after), strict=True)
            )
            own = changes_between(old, new)
        except (ArtifactError, StoreError):
            yield f"another {kind}, of which not both folders have the record"
            return
        except (AttributeError, KeyError, TypeError, ValueError):
            yield f"another {kind}, whose record is damaged"
            return
        yield from own
        first, second = upstream_of(old), upstream_of(new)
        pairs = [
            (second[name][0], needed, second[name][1])
            for name, (_, needed) in first.items()
            if name in second
        ]
        upstream = [
            (other, needed, needed_too)
            for other, needed, needed_too in pairs
            if needed != needed_too
        ]
        for each in upstream:
            yield from self._follow(*each)
        reads = sorted({*mapping(old.get("upstream"))} ^ {*mapping(new.get("upstream"))})
        if reads:
            yield f"{kind}: reads other artifacts: {few(reads)}"
        if not own and not upstream and not reads:
            yield f"{kind}: another cell of the grid, or a key of another version"

    def _machine(self, kind: str, key: str) -> Iterator[str]:
        try:
            manifests = [read_manifest(layout, kind, key) for layout in self._layouts]
        except (ArtifactError, StoreError):
            return
        machines = [mapping(each.get("provenance")) for each in manifests]
        libraries = [mapping(each.get("versions")) for each in machines]
        for (old, new), names in (
            (machines, MACHINE),
            (libraries, dict.fromkeys((*libraries[0], *libraries[1]))),
        ):
            pairs = (
                (name, str(old.get(name) or "unknown"), str(new.get(name) or "unknown"))
                for name in names
            )
            yield from (f"{name} {one} -> {two}" for name, one, two in pairs if one != two)
