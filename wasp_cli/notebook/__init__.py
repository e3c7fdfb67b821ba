"""A results folder as Arrow tables.

    results = wasp_cli.results("results")                                  # of the spec that ran
    last; spec="table1" for another results.episodes(method="wasp", operator="laggy").to_pandas()
    # a row per episode results.steps(method="wasp", columns=["t", "cost", "gate"])            # a
    row per decision results.branches()                                                     # a row
    per intervention that was tested counterfactually results.trained(kind="world_model")
    # a row per trained part, with its numbers results.table("main")
    # a table of the report results.cell("goal1 s1 wasp laggy=0.7").replay(episode=0)              #
    frames

Nothing is computed, and torch is imported by `replay` alone. Columns have the names of `wasp run
--select`: `variant` is the ablation, `operator` the impaired operator, `value` its severity's
value.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wasp_cli.cells.cell import RecordedCell, stored_cells
from wasp_cli.cells.runs import RunRecord, recorded_runs
from wasp_cli.errors import StoreError, UnknownName, UsageError
from wasp_cli.notebook import cells as reading
from wasp_cli.notebook.cells import Names, Numbers
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.find import KIND, FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.store.named import matching

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa
    from numpy.typing import NDArray

Columns = Iterable[str] | None


def open_results(
    folder: str | Path = "results", spec: str | Sequence[str] | None = None
) -> Results:
    """Open a results folder.

    Args:
        folder: as `wasp run --results` wrote it, or one without runs, such as `results/published`.
        spec: whose cells: a name, or several. None: of the spec that ran last; everything in the
            store of a folder without runs.

    Raises:
        StoreError: there is no such folder.
        UnknownName: no such spec has run there.
    """
    layout = Layout(Path(folder))
    last = recorded_runs(layout)
    for wrong in last.damaged:
        warnings.warn(wrong, stacklevel=2)
    runs = last.runs
    if not runs and not layout.store.is_dir():
        raise StoreError(
            f"no results in '{folder}': it has neither runs nor a store",
            "wasp run SPEC --results DIR writes there",
        )
    if spec is None:
        named = list(runs)[-1:]
    elif isinstance(spec, str):
        named = [spec]
    else:
        named = list(spec)
    for name in named:
        if name not in runs:
            raise UnknownName("spec in these results", name, runs)
    return Results(layout, runs, tuple(named))


class Results:
    """The cells of one spec, or of several, and everything that is stored of them.

    Every method takes a value or a list of values to choose by, and raises UnknownName for one that
    no cell has. What is not computed has no rows; `missing` lists it.
    """

    def __init__(
        self, layout: Layout, runs: Mapping[str, RunRecord], named: tuple[str, ...]
    ) -> None:
        self._layout = layout
        self._runs = runs  # the last run of each spec, by its name
        self._named = named  # the specs whose cells these are

    @property
    def specs(self) -> list[str]:
        """All specs that have run in the folder, oldest first."""
        return list(self._runs)

    @cached_property
    def cells(self) -> list[RecordedCell]:
        """The cells, computed or not, in the order of the spec."""
        if not self._runs:
            return stored_cells(self._layout)
        return [cell for name in self._named for cell in self._runs[name].cells]

    @property
    def missing(self) -> list[str]:
        """The labels of cells that are not computed."""
        return [cell.label for cell in self.cells if reading.table_of(self._layout, cell) is None]

    def __repr__(self) -> str:
        whose = "without runs"
        if self._runs:
            whose = f"spec={', '.join(map(repr, self._named)) or 'none'}"
        return f"<wasp results '{self._layout.root}', {whose}: {len(self.cells)} cells>"

    def episodes(
        self,
        *,
        task: Names = None,
        method: Names = None,
        variant: Names = None,
        operator: Names = None,
        severity: Names = None,
        value: Numbers = None,
        seed: Numbers = None,
        key: Names = None,
        columns: Columns = None,
    ) -> pa.Table:
        """Read a row per episode: names of the cell, then its measures and thresholds;
        `.to_pandas()` of it is a data frame.

        Args:
            task, method: only these; so for the next ones.
            variant: the ablation; `full` for the method itself.
            operator: as the spec names it; `none` for the expert's.
            severity, value: the spec's name, such as `moderate`; and its number.
            seed, key: of cells; a key is whole.
            columns: which measures; None for all.

        Raises:
            UnknownName: no cell has such a task, method, ...
            KeyError: no such column.
            StoreError: rows are damaged.
        """
        cells = self._chosen(task, method, variant, operator, severity, value, seed, key)
        return reading.stacked(self._layout, cells, reading.episodes_of, reading.EPISODE, columns)

    def steps(
        self,
        *,
        task: Names = None,
        method: Names = None,
        variant: Names = None,
        operator: Names = None,
        severity: Names = None,
        value: Numbers = None,
        seed: Numbers = None,
        key: Names = None,
        columns: Columns = None,
    ) -> pa.Table:
        """Read a row per decision; arguments and errors are those of `episodes`. Of large
        results name the columns that you need.
        """
        cells = self._chosen(task, method, variant, operator, severity, value, seed, key)
        return reading.all_steps(self._layout, cells, columns)

    def branches(
        self,
        *,
        task: Names = None,
        method: Names = None,
        variant: Names = None,
        operator: Names = None,
        severity: Names = None,
        value: Numbers = None,
        seed: Numbers = None,
        key: Names = None,
        columns: Columns = None,
    ) -> pa.Table:
        """Read a row per counterfactually tested decision: both branches, and whether the
        intervention was necessary. As `episodes`.
        """
        cells = self._chosen(task, method, variant, operator, severity, value, seed, key)
        return reading.stacked(self._layout, cells, reading.branches_of, reading.BRANCH, columns)

    def trained(self, *, task: Names = None, kind: Names = None, seed: Numbers = None) -> pa.Table:
        """Read a row per trained part: key, kind, folder, seconds, and every number that its stage
        reports.

        Args:
            task: only these.
            kind: of stage, such as `world_model`.
            seed: of the training.

        Raises:
            UnknownName: no part has such a task, kind or seed.
        """
        parts: list[tuple[str, str]] | None = None  # of a folder without runs all that there is
        if self._runs:
            planned = [part for name in self._named for part in self._runs[name].parts]
            parts = [(part.kind, key) for part, key in planned]
        return reading.trained_table(
            self._layout,
            [cell.key for cell in self.cells],
            parts,
            {"task": task, "kind": kind, "seed": seed},
        )

    def table(self, name: str = "main") -> pa.Table:
        """Make a table of the report: `main`, `table2`, `figure3`, `statistics`, `operators`,
        `severity`, `details`, `latency`, ...

        Numbers are unscaled, as in the report's CSV files; `_sd`, `_low` and `_high` columns have
        the spread.

        Raises:
            UsageError: the results are of no spec, or of several.
            UnknownName: the report has no such table.
            ArtifactError: the record of the run is damaged.
        """
        if len(self._named) != 1:
            raise UsageError(
                "a table is of one spec",
                "wasp_cli.results(folder, spec=...) with one of: "
                f"{', '.join(self.specs) or 'none'}",
            )
        return reading.report_table(self._runs[self._named[0]], name)

    def cell(self, label: str) -> StoredCell:
        """Find a computed cell by its label, as `wasp run` prints it, or by the beginning of its
        key.

        Raises:
            UnknownName: there is none.
            UsageError: several have this label, or it is not computed.
        """

        cells = {cell.key: cell for cell in matching(self.cells, label)}
        if not cells:
            raise UnknownName("cell", label, [cell.label for cell in self.cells])
        if len(cells) > 1:
            raise UsageError(
                f"'{label}' names {len(cells)} cells: {', '.join(cells)}",
                "give the first characters of one of these keys",
            )
        (cell,) = cells.values()
        path = reading.table_of(self._layout, cell)
        if path is None:
            raise UsageError(f"'{cell.label}' is not computed yet", "wasp status says why")
        return StoredCell(self._layout, cell, path)

    def _chosen(self, *values: Any) -> list[RecordedCell]:
        names = ("task", "method", "variant", "operator", "severity", "value", "seed", "key")
        cells = reading.chosen(self.cells, dict(zip(names, values, strict=True)))
        alike = Counter(
            (cell.spec, cell.identity) for cell in {cell.key: cell for cell in cells}.values()
        )
        twice = sum(count for count in alike.values() if count > 1)
        if twice:
            told = (
                f"{twice} of {len(cells)} cells share their names with another, of other "
                "settings or code"
            )
            warnings.warn(
                f"{told}: the column `key` tells them apart, and key=[...] chooses", stacklevel=3
            )
        return cells


@dataclass(frozen=True)
class StoredCell:
    """A computed cell; see `Results.cell`. Reading raises a StoreError where rows are damaged."""

    layout: Layout
    names: RecordedCell
    path: Path  # of its table

    @property
    def key(self) -> str:
        """Name of its folder in `store/evaluate`."""
        return self.names.key

    @property
    def label(self) -> str:
        """As `wasp run` prints it."""
        return self.names.label

    @property
    def manifest(self) -> dict[str, Any]:
        """What is recorded of it: configuration, inputs, versions, time."""
        return read_manifest(self.layout, KIND, self.key)

    def __repr__(self) -> str:
        return f"<wasp cell '{self.label}', {self.key}>"

    def episodes(self) -> pa.Table:
        """Read a row per episode."""
        return reading.stacked(
            self.layout, [self.names], reading.episodes_of, reading.EPISODE, None
        )

    def steps(self, episode: int | None = None) -> pa.Table:
        """Read a row per decision, of one episode or of all.

        Raises:
            UsageError: there is no such episode, or its steps are not here.
        """
        if episode is None:
            return reading.all_steps(self.layout, [self.names], None)
        import pyarrow.compute as pc

        from wasp_cli.report.explain.episode import read_episode

        # refuses what is not here
        read_episode(FoundCell(self.path, self.key, self.manifest), episode)
        rows = reading.stacked(self.layout, [self.names], reading.steps_of, reading.STEPS, None)
        return rows.filter(pc.equal(rows["episode"], episode))

    def branches(self) -> pa.Table:
        """Read a row per counterfactually tested decision."""
        return reading.stacked(self.layout, [self.names], reading.branches_of, reading.BRANCH, None)

    def replay(self, episode: int = 0, every: int | None = None) -> Iterator[NDArray[np.uint8]]:
        """Play an episode again and draw the frames of `wasp replay`: map, cameras, imagined
        futures, gates; uint8 [704, 976, 3] each.

        Needs torch and the cell's models in the results folder.

        Args:
            episode: counted from 0.
            every: decisions between two frames; None: so many that there are at most 125 frames.

        Raises:
            UsageError: no such episode, or `every` is none.
            ArtifactError: a model is missing or damaged, or what is played is not what was
                recorded.
        """
        from wasp_cli.video.replay import replay_frames

        if every is not None and (not isinstance(every, int) or every < 1):
            raise UsageError(
                f"every={every!r} is no number of decisions",
                "give a whole number from 1 on, or None",
            )
        yield from replay_frames(
            self.layout, FoundCell(self.path, self.key, self.manifest), episode, every
        )
