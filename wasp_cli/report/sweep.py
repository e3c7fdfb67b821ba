"""The report of a sweep: its tables and curves once, printed, written, or for machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from wasp_cli.plan.node import Cell
from wasp_cli.report.axis_figures import sweep_figures
from wasp_cli.report.render import make_own, markdown, terminal, write_pages
from wasp_cli.report.stats import Missing
from wasp_cli.report.summarize import identity_of, name_missing, report_run
from wasp_cli.report.tables import by_axis
from wasp_cli.report.tables.table import Table
from wasp_cli.spec.derived import Sweep


@dataclass(frozen=True)
class SweepReport:
    name: str
    spec: str
    key: str
    swept: tuple[by_axis.Swept, ...]
    damaged: tuple[str, ...] = ()  # records that do not read
    published: tuple[str, ...] = ()  # what was published and not computed here

    @property
    def missing(self) -> tuple[Missing, ...]:
        return by_axis.combined(self.key, self.swept).missing

    @cached_property
    def tables(self) -> tuple[Table, Table]:
        return by_axis.sweep_table(self.key, self.swept), by_axis.sweep_operator_table(self.key, self.swept)

    def terminal(self, console: Console) -> None:
        for table in self.tables:
            if table.rows:
                console.print(terminal(table, console.width))
        for fact in self.published:
            console.print(Text(fact), soft_wrap=True)
        name_missing(console, self.missing)

    def write(self, folder: Path) -> list[Path]:
        make_own(folder)
        figures = sweep_figures(self.key, self.swept, folder)
        pages = write_pages(folder, {"report.md": self.markdown([path.name for path in figures])}, self.tables)
        for path in {*folder.glob("sweep_*.png"), *folder.glob("sweep_*.svg")} - {*figures}:
            path.unlink(missing_ok=True)  # of a task that an earlier sweep had
        return [*pages, *figures]

    def markdown(self, figures: Sequence[str] = ()) -> str:
        frame = by_axis.combined(self.key, self.swept)
        values = ", ".join(f"`{each.text}`" for each in self.swept)
        facts = [
            f"Spec `{self.spec}`, `{self.key}` = {values}.",
            f"{len(frame.cells)} of {len(frame.order)} different cells, {sum(cell.count for cell in frame.cells)} episodes.",
            *self.published,
            *self.damaged,
        ]
        parts = [f"# Sweep: {self.name}\n", "".join(f"- {fact}\n" for fact in facts)]
        if frame.missing:
            parts.append("## Missing cells\n\n" + "".join(f"- {cell.label}: {cell.reason}\n" for cell in frame.missing))
        whole, by_operator = self.tables
        parts.append(markdown(whole))
        parts += [f"![{self.key}]({name})\n" for name in figures if name.endswith(".png")]
        parts.append(markdown(by_operator))
        return "\n".join(parts)

    def as_json(self) -> dict[str, Any]:
        rows = by_axis.lines(self.swept)
        return {
            "name": self.name,
            "spec": self.spec,
            "setting": self.key,
            "values": [each.value for each in self.swept],
            "rows": [line.as_json(by_axis.SWEEP_COLUMNS) for line in rows],
            "operators": [line.as_json(by_axis.SWEEP_OPERATOR_COLUMNS) for line in by_axis.operator_lines(self.swept, rows)],
            "missing": [{"cell": gap.label, "reason": gap.reason} for gap in self.missing],
        }


def report_sweep(results: Path, sweep: Sweep, cells: Sequence[Sequence[tuple[Cell, str]]]) -> SweepReport:
    swept: list[by_axis.Swept] = []
    damaged: list[str] = []
    published: list[str] = []
    for point, own in zip(sweep.points, cells, strict=True):
        report = report_run(results, point.loaded.spec, own)
        damaged += report.damaged
        published += [f"`{sweep.key}` = `{point.text}`: {fact}" for fact in report.published]
        swept.append(by_axis.Swept(point.text, point.value, report.frame, {identity_of(cell): key for cell, key in own}))
    return SweepReport(sweep.name, sweep.spec, sweep.key, tuple(swept), tuple(dict.fromkeys(damaged)), tuple(published))
