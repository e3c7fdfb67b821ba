"""What `wasp bench planner` measured, for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from wasp_cli.report.stats.summary import Value
from wasp_cli.report.tables.table import Column, Row, Table

if TYPE_CHECKING:
    from wasp_cli.studies.planner_timing import Bench

COLUMNS = (
    Column("ms", "ms", digits=1),
    Column("ms_p50", "ms, median", digits=1),
    Column("gflop", "GFLOP"),
    Column("ratio", "time / products"),
)
MEANINGS = {
    "gate": "nominal rollouts alone", "quiet": "both gates silent", "safety": "planner after the safety gate",
    "task": "planner after the task gate, whose probe is its first iteration",
}  # fmt: skip
TABLE1: Mapping[str, float] = {"race1": 0.15, "formula1": 0.20, "goal1": 0.25}
"""Intervention rates of WASP in Table 1 of the paper."""
DECISION_SECONDS: Mapping[str, float] = {"race1": 0.16, "formula1": 0.16, "goal1": 0.08}
"""Simulated time of a decision of four env steps."""


def bench_table(found: Mapping[str, Bench]) -> Table:
    """Time of every kind of decision, for the whole batch."""
    rows = [
        Row((name, timing.kind), tuple(Value(getattr(timing, column.key), ranked=False) for column in COLUMNS))
        for name, bench in found.items()
        for timing in bench.timings
    ]
    last = list(found.values())[-1]
    episodes = f"{last.batch} episode{'s side by side' if last.batch > 1 else ''}"
    threads = f"{last.threads} thread{'s' if last.threads > 1 else ''}"
    said = (
        f"{episodes}, {threads}; plain matrix products reach {last.roof:.0f} GFLOP/s in the same run.",
        "; ".join(f"{kind}: {meaning}" for kind, meaning in MEANINGS.items()) + ".",
    )
    return Table("planner", "A decision of WASP", ("Planner", "Decision"), COLUMNS, tuple(rows), said)


def notes(name: str, bench: Bench) -> Iterator[str]:
    """What the time goes to, and the mean decision at the paper's intervention rates."""
    spent = ", ".join(f"{operator} {100 * share:.0f} %" for operator, share in bench.shares.items())
    yield f"{name}: time of a safety decision by operator: {spent}"
    for task, rate in TABLE1.items():
        # The paper does not say which gate fired: half of the interventions each.
        mean = bench.mean_ms(rate / 2, rate / 2)
        yield f"{name}: mean decision at Int. {rate:.2f} ({task}): {mean:.0f} ms; a decision lasts {1000 * DECISION_SECONDS[task]:.0f} ms"
