"""The numbers of every cell that a report is about, and the names of those that are missing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from wasp_cli.errors import StoreError
from wasp_cli.metrics.episode import WEIGHTS, pool
from wasp_cli.metrics.necessity import ALONE, ASSISTED, Necessity, necessity
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.numbers import Numbers, read_numbers
from wasp_cli.store.parquet import AGAIN
from wasp_cli.store.tables import (
    SCHEMA,
    CellIdentity,
    Thresholds,
    cell_file,
    lacking,
    read_episodes,
    read_version,
)

Floats = NDArray[np.float64]
Result = TypeVar("Result")

# columns that weigh others (metrics.episode.WEIGHTS)
POOLING = ("decisions", "env_steps", "intervened", "planned", "handovers")
# columns of which a cell has the median over its episodes
TIMES = ("decision_p50_ms", "decision_p95_ms")
COLUMNS = (*WEIGHTS, *POOLING, *TIMES, "episode_seed")  # what is read of a cell

JUDGED = ("uir", "uir_swapped", "uir_eff", "rho", "at_risk", "delta_c", "delta_r")
"""Columns of the counterfactual evaluation, in the cells that have one (`with_branches`)."""

BRANCHES, EFFECTIVE = "branches", "effective_branches"
"""Columns of how many decisions of an episode were branched, and of how many of these the
branches differ.
"""

WEIGHT_OF: dict[str, str | None] = {
    **WEIGHTS,
    "smoothness": "jumps",
    **dict.fromkeys(JUDGED, BRANCHES),
    "uir_eff": EFFECTIVE,
}
"""The columns that are means over episodes, each with the column that weighs it; None is one
weight per episode.
"""


@dataclass(frozen=True)
class Wanted:
    identity: CellIdentity
    label: str
    path: Path
    severity: str | None = None  # the spec's name of the severity value
    failure: str | None = None  # why its last computation failed, where that is known
    blocked: str | None = None  # which failed node stands in its way, where that is known
    refused: str | None = None  # why its file is not read though it may be there
    # its counterfactual branches, where somebody asked for them: the same of their table
    branches: Wanted | None = None
    # the seed of the training whose models it uses; None: the cell's own seed
    chain_seed: int | None = None

    @classmethod
    def stored(
        cls, layout: Layout, kind: str, key: str, identity: CellIdentity, label: str, **known: Any
    ) -> Wanted:
        """Return what a results folder has under a key, a cell or its branches; what leads out
        of the folder is not read.
        """
        folder, refused = layout.artifact(kind, key), None
        path = cell_file(folder) if kind == KIND else folder / BRANCHES_FILE
        try:
            layout.within(path)
        except StoreError as error:
            refused = error.message
        return cls(identity, label, path, refused=refused, **known)


@dataclass(frozen=True)
class Missing:
    """A wanted cell without readable rows."""

    identity: CellIdentity
    label: str
    reason: str
    key: str = ""
    damaged: bool = False  # whether its rows are there and do not read
    kind: str = "evaluate"  # of the node that makes them
    invalid: bool = False  # whether a person marked it so


@dataclass(frozen=True, eq=False)
class CellNumbers:
    identity: CellIdentity
    severity: str | None
    pooled: Mapping[str, float]
    """By column of WEIGHT_OF or TIMES; NaN is undefined. Of JUDGED only in cells whose
    interventions were branched.
    """
    episodes: Mapping[str, Floats]
    """[E] per column of WEIGHT_OF, its weights, TIMES, and `world`: the episode's seed, which is
    that of the same world under every assistant and operator of a task and seed. NaN is undefined.
    Views into one array for all cells of a frame: do not write."""
    thresholds: Thresholds = field(default_factory=Thresholds)
    chain_seed: int | None = None

    @property
    def training(self) -> int:
        """Return the seed of the training whose models it uses: cells of several seeds share
        one where the spec has `training_seed`.
        """
        return self.identity.seed if self.chain_seed is None else self.chain_seed

    @property
    def count(self) -> int:
        return len(self.episodes["world"])

    def weighted(self, key: str) -> tuple[Floats, Floats]:
        """Return [E] each: weight x value, and weight, of a column of WEIGHT_OF; both 0 where it is
        undefined.

        The pooled value is the ratio of their sums.
        """
        values, weight = self.episodes[key], WEIGHT_OF[key]
        mass = np.where(np.isnan(values), 0.0, 1.0 if weight is None else self.episodes[weight])
        return mass * np.nan_to_num(values), mass


@dataclass(frozen=True, eq=False)
class Judged:
    worth: Necessity
    episode: NDArray[np.int64]  # [N]
    window: int  # W
    tau_R: float


@dataclass(frozen=True)
class Frame:
    cells: tuple[CellNumbers, ...]
    missing: tuple[Missing, ...] = ()
    order: tuple[CellIdentity, ...] = ()  # all wanted cells, as they were asked for
    # the cells whose interventions were branched
    judged: Mapping[CellIdentity, Judged] = field(default_factory=dict)
    # the cells with rows whose interventions should have been branched, and were not
    unbranched: tuple[Missing, ...] = ()
    # whose cells are left out, since it is not installed here, each as a sentence
    absent: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Group:
    task: str
    method: str
    variant: str
    cells: tuple[CellNumbers, ...]
    absent: int  # cells that are missing

    @property
    def assistant(self) -> tuple[str, str, str]:
        return self.task, self.method, self.variant

    @property
    def complete(self) -> bool:
        return self.absent == 0

    def of_variant(self, variant: str) -> list[CellNumbers]:
        return [cell for cell in self.cells if cell.identity.operator == variant]


def groups(frame: Frame) -> list[Group]:
    """List the rows that a frame has, also those without any readable cell: by task, then in
    the order of the wanted cells.
    """
    rows: dict[tuple[str, str, str], list[CellNumbers]] = {
        row_of(identity): [] for identity in frame.order
    }
    for cell in frame.cells:
        rows.setdefault(row_of(cell.identity), []).append(cell)
    absent = Counter(row_of(gap.identity) for gap in frame.missing)
    listed = [Group(*row, tuple(cells), absent[row]) for row, cells in rows.items()]
    tasks = list(dict.fromkeys(group.task for group in listed))
    methods = list(dict.fromkeys(group.method for group in listed))
    return sorted(listed, key=lambda group: (tasks.index(group.task), methods.index(group.method)))


def row_of(identity: CellIdentity) -> tuple[str, str, str]:
    return identity.task, identity.method, identity.variant


def read_frame(wanted: Iterable[Wanted]) -> Frame:
    """Read the cells that exist; name those that do not, or that cannot be read."""
    wanted = tuple(wanted)
    results = [_read(cell) for cell in wanted]
    read = [
        (cell, numbers)
        for cell, numbers in zip(wanted, results, strict=True)
        if not isinstance(numbers, Missing)
    ]
    missing = tuple(gap for gap in results if isinstance(gap, Missing))
    return Frame(tuple(pool_cells(read)), missing, tuple(cell.identity for cell in wanted))


def _or_missing(wanted: Wanted, kind: str, read: Callable[[Path], Result]) -> Result | Missing:
    """What is read of a table; a report names what is not there or damaged and goes on, and
    never averages without it in silence.
    """
    missing = partial(Missing, wanted.identity, wanted.label, kind=kind)
    if wanted.refused is not None:
        return missing(f"refused: {wanted.refused}")
    key = wanted.path.parent.name
    if not wanted.path.exists():
        blocked = f"blocked by {wanted.blocked}" if wanted.blocked else "not computed yet"
        return missing(f"failed: {wanted.failure}" if wanted.failure else blocked, key)
    try:
        with odd_tables_refused(wanted.path):
            return read(wanted.path)
    except StoreError as error:
        return missing(
            error.message + (f" ({error.hint})" if error.hint else ""), key, damaged=True
        )


def _read(cell: Wanted) -> Numbers | Missing:
    def numbers(path: Path) -> Numbers:
        rows = read_numbers(path, COLUMNS) or _read_closely(path)
        if rows.identity != cell.identity:
            raise StoreError(f"{path} holds another cell: {rows.identity}")
        # an error where two worlds would become one number
        rows.table["episode_seed"].cast(pa.float64())
        return rows

    return _or_missing(cell, KIND, numbers)


def _read_closely(path: Path) -> Numbers:
    """The rows of a cell of an older version; an error says what is wrong with a damaged one."""
    try:
        table = read_episodes([path])
    except ValueError as error:  # its columns are not those of a cell
        there = pq.read_schema(path).names
        absent = ", ".join(
            name for name in SCHEMA.names if name not in (*there, *lacking(read_version(path)))
        )
        raise StoreError(
            f"{path} is damaged: {f'it has no column {absent}' if absent else error}", AGAIN
        ) from error
    if table.num_rows == 0:
        raise StoreError(f"{path} has no episodes")
    row = table.slice(0, 1).to_pylist()[0]
    identity = CellIdentity(**{name: row[name] for name in CellIdentity.__dataclass_fields__})
    thresholds = Thresholds(**{name: row[name] for name in Thresholds.__dataclass_fields__})
    return Numbers(identity, thresholds, table.select(COLUMNS))


@contextmanager
def odd_tables_refused(path: Path) -> Iterator[None]:
    """Raise StoreError inside the block also for what `store.tables` never writes, but a
    Parquet file may hold.
    """
    try:
        if not path.is_file():  # a pipe would hold the reader for ever
            raise StoreError(f"{path} is no plain file")
        yield
    except (
        pa.ArrowException,
        ArithmeticError,
        AttributeError,
        LookupError,
        MemoryError,
        TypeError,
        ValueError,
    ) as error:
        what = " ".join(str(error).split())[:200]
        raise StoreError(f"{path} is not as wasp writes it: {what}", AGAIN) from error


def pool_cells(stored: Sequence[tuple[Wanted, Numbers]]) -> list[CellNumbers]:
    """Pool the episodes of every cell: rates are ratios of sums."""
    if not stored:
        return []
    rows = pa.concat_tables([numbers.table for _, numbers in stored])
    sizes = np.array([numbers.table.num_rows for _, numbers in stored])
    columns = {name: _floats(rows[name].combine_chunks().cast(pa.float64())) for name in COLUMNS}
    columns |= {"jumps": columns["decisions"] - 1.0, "world": columns.pop("episode_seed")}
    pooled = pool(columns, np.repeat(np.arange(len(stored)), sizes))
    starts = np.concatenate([[0], np.cumsum(sizes)])
    cells = []
    for i, (cell, numbers) in enumerate(stored):
        part = slice(int(starts[i]), int(starts[i + 1]))
        episodes = {name: values[part] for name, values in columns.items()}
        of_cell = {name: float(values[i]) for name, values in pooled.items()}
        of_cell |= {name: median_of(episodes[name]) for name in TIMES}
        cells.append(
            CellNumbers(
                cell.identity, cell.severity, of_cell, episodes, numbers.thresholds, cell.chain_seed
            )
        )
    return cells


def _floats(array: pa.Array) -> Floats:
    """[N] the numbers of a column, NaN where there is none. `to_numpy` would import pandas
    where that is installed: a third of a second.
    """
    known, numbers = array.buffers()
    values = np.frombuffer(numbers, np.float64, len(array), 8 * array.offset)
    if not array.null_count:
        return values
    return np.where(
        np.unpackbits(np.frombuffer(known, np.uint8), bitorder="little")[array.offset :][
            : len(array)
        ],
        values,
        np.nan,
    )


def median_of(values: Floats) -> float:
    defined = values[~np.isnan(values)]
    return float(np.median(defined)) if len(defined) else float("nan")


def with_branches(frame: Frame, wanted: Iterable[Wanted]) -> Frame:
    """Return the frame with JUDGED and their weights as columns of the cells that have branches;
    `unbranched` names those that should.

    An episode's number is the mean over its branched interventions, undefined where there are none;
    so is that of a cell.
    """
    asked = {cell.identity: cell.branches for cell in wanted if cell.branches is not None}
    read = {
        cell.identity: _judged(asked[cell.identity], cell)
        for cell in frame.cells
        if cell.identity in asked
    }
    judged = {identity: worth for identity, worth in read.items() if not isinstance(worth, Missing)}
    gaps = tuple(gap for gap in read.values() if isinstance(gap, Missing))
    cells = tuple(
        _with_columns(cell, judged[cell.identity]) if cell.identity in judged else cell
        for cell in frame.cells
    )
    return replace(frame, cells=cells, judged=judged, unbranched=gaps)


def _judged(branches: Wanted, cell: CellNumbers) -> Judged | Missing:
    def worth(path: Path) -> Judged:
        stored = read_branches(path)
        if stored.cell.identity != cell.identity:
            raise ValueError(f"it holds the branches of another cell: {stored.cell.identity}")
        if (
            stored.cell.episodes != cell.count
            or (stored.episode < 0).any()
            or (stored.episode >= cell.count).any()
        ):
            raise ValueError(
                f"it is about {stored.cell.episodes} episodes, and the cell has {cell.count}"
            )
        cost, reward, tau_R = stored.cost, stored.reward, stored.cell.tau_R
        # Eq. 19-21
        of_branches = necessity(cost[ALONE], cost[ASSISTED], reward[ALONE], reward[ASSISTED], tau_R)
        return Judged(of_branches, stored.episode, stored.cell.window, tau_R)

    return _or_missing(branches, COUNTERFACTUAL, worth)


def _with_columns(cell: CellNumbers, judged: Judged) -> CellNumbers:
    columns: dict[str, Floats] = {}
    pooled: dict[str, float] = {}
    for name, every in numbers_of(judged.worth).items():
        defined = ~np.isnan(every)
        episode, values = judged.episode[defined], every[defined]
        count = np.bincount(episode, minlength=cell.count).astype(np.float64)
        total = np.bincount(episode, values, cell.count)
        columns |= {
            name: np.divide(total, count, out=np.full(cell.count, np.nan), where=count > 0),
            str(WEIGHT_OF[name]): count,
        }
        pooled[name] = float(values.mean()) if len(values) else float("nan")
    return replace(cell, episodes={**cell.episodes, **columns}, pooled={**cell.pooled, **pooled})


def numbers_of(worth: Necessity) -> dict[str, Floats]:
    """Return [N] per column: one number for each branched intervention, NaN where it does not
    count.
    """
    unnecessary = worth.unnecessary.astype(np.float64)
    return {
        "uir": unnecessary,
        "uir_swapped": worth.swapped.astype(np.float64),
        "uir_eff": np.where(worth.effective, unnecessary, np.nan),
        "rho": worth.rho,
        "at_risk": (worth.rho > 0.0).astype(np.float64),
        "delta_c": worth.delta_c,
        "delta_r": worth.delta_r,
    }


def of_episodes(cell: CellNumbers, rest: NDArray[np.bool_]) -> CellNumbers | None:
    """Return a cell pooled over the episodes for which `rest` [E] is true; None without any."""
    if rest.all() or not rest.any():
        return cell if rest.all() else None
    # which ones these are, where they are not all
    numbers = {"episode": np.arange(float(cell.count))}
    kept = replace(
        cell, episodes={name: values[rest] for name, values in {**numbers, **cell.episodes}.items()}
    )
    pooled = {}
    for name in cell.pooled:
        if name in TIMES:
            pooled[name] = median_of(kept.episodes[name])
        elif name in WEIGHT_OF:
            mass, weight = kept.weighted(name)
            pooled[name] = float(mass.sum() / weight.sum()) if weight.sum() else float("nan")
    return replace(kept, pooled=pooled)


def condition(identity: CellIdentity) -> tuple[str, str, float | None, int]:
    """Return what two cells have in common that can be compared in pairs: task, operator,
    severity and seed.
    """
    return identity.task, identity.operator, identity.value, identity.seed


def pairs_of(
    cells: Iterable[CellNumbers], reference: Iterable[CellNumbers], key: str
) -> list[tuple[CellNumbers, CellNumbers]]:
    """Return the cells under conditions of both sides that define a column, each pair over the
    worlds that both have.
    """
    by_condition = {condition(cell.identity): cell for cell in reference}
    pairs = []
    for cell in cells:
        other = by_condition.get(condition(cell.identity))
        if other is not None:
            one, two = cell.episodes["world"], other.episodes["world"]
            # as nearly always; to look for each takes twenty times as long
            same = np.array_equal(one, two)
            pairs.append(
                (cell, other)
                if same
                else (of_episodes(cell, np.isin(one, two)), of_episodes(other, np.isin(two, one)))
            )
    return [
        (own, other)
        for own, other in pairs
        if own and other and len(defining((own, other), key)) == 2
    ]


def defining(cells: Iterable[CellNumbers], key: str) -> list[CellNumbers]:
    """Leave out the cells in which a pooled column is missing or undefined."""
    return [cell for cell in cells if not math.isnan(cell.pooled.get(key, math.nan))]
