"""The paper's numbers beside the measured ones, as a table; and how a column of a claim is printed."""

from __future__ import annotations

from dataclasses import replace

from wasp_cli.report.claims.verdict import Beside, VerdictReport
from wasp_cli.report.stats.bootstrap import Estimate
from wasp_cli.report.stats.summary import UNDEFINED, Value
from wasp_cli.report.tables.details import DETAIL_COLUMNS
from wasp_cli.report.tables.main import MORE_COLUMNS, PAPER_COLUMNS
from wasp_cli.report.tables.necessity import MEANS as NECESSITY
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import task_title, who_title
from wasp_cli.spec.paper import Printed, Who

COLUMN_OF = {column.key: column for column in (*PAPER_COLUMNS, *MORE_COLUMNS, *DETAIL_COLUMNS, *NECESSITY)}
"""Everything that a claim may be about (spec.paper.COLUMNS)."""
PRINTED_DIGITS = 2
LABELS = ("Table", "Task", "Method")
MEANINGS = (
    "paper: as it prints it. here: our mean [95 % interval] (our mean minus the paper's).",
    "The paper does not say what its ± is taken over, and its models, severities and episodes are others: numbers show the size of an "
    "effect, and the claims its direction.",
)


def numbers_table(verdict: VerdictReport) -> Table | None:
    """Return each printed number beside the measured one, for the tasks that are here; None where the paper prints nothing of them."""
    keys = list(dict.fromkeys(key for row in verdict.rows for key in _columns(verdict, row)))
    if not verdict.rows:
        return None
    columns = [column for key in keys for column in (_column(key, "paper"), _column(key, "here"))]
    rows = [Row((row.table, task_title(row.task), title_of(row.who) + ("" if not row.note else " [incomplete]")),
                _values(verdict, row, keys)) for row in verdict.rows]  # fmt: skip
    absent = sum(len(found) for table in verdict.paper.tables for found in table.rows.values()) - len(rows)
    notes = [f"{absent} of the paper's rows are of tasks or ablations that this spec does not run."] if absent else []
    return Table(
        "paper",
        "Comparison with the paper",
        LABELS,
        tuple(columns),
        tuple(rows),
        tuple(notes),
        MEANINGS,
        grouping=2,
        ranked=False,
    )


def title_of(who: Who) -> str:
    """Return the name of a row in tables."""
    return who_title(who.method, who.variant)


def _columns(verdict: VerdictReport, row: Beside) -> tuple[str, ...]:
    return next(table.columns for table in verdict.paper.tables if table.name == row.table)


def _column(key: str, whose: str) -> Column:
    column = COLUMN_OF[key]
    if whose == "here":
        return replace(column, title=f"{column.title}, here")
    return replace(column, key=f"{key}_paper", title=f"{column.title}, paper", digits=min(column.digits, PRINTED_DIGITS))


def _values(verdict: VerdictReport, row: Beside, keys: list[str]) -> tuple[Value, ...]:
    found = dict(zip(_columns(verdict, row), zip(row.printed, row.ours, strict=True), strict=True))
    values: list[Value] = []
    for key in keys:
        printed, ours = found.get(key, (None, None))
        values += [_printed(printed, key), _ours(ours, printed, key, verdict.seeds)]
    return tuple(values)


def _printed(printed: Printed | None, key: str) -> Value:
    """The paper's number in the unit of the rows: its page has percent."""
    if printed is None:
        return UNDEFINED
    scale = COLUMN_OF[key].scale
    return Value(printed.mean / scale, None if printed.spread is None else printed.spread / scale, ranked=False)


def _ours(ours: Estimate | None, printed: Printed | None, key: str, seeds: int) -> Value:
    if ours is None:
        return UNDEFINED
    theirs = _printed(printed, key).mean
    return Value(ours.value, n=seeds, delta=None if theirs is None else ours.value - theirs, ranked=False, interval=ours.interval)
