"""Tables of what people did: measures and answers by condition, the effect of the order, and how well decisions were in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import pyarrow as pa

from wasp_cli.report.stats.bootstrap import RESAMPLES
from wasp_cli.report.stats.people import WORKLOAD, Sitting, compared, condition_of, deviations, measured, over_participants
from wasp_cli.report.stats.summary import UNDEFINED, Value
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.report.tables.table import Column, Row, Table
from wasp_cli.report.tables.titles import task_title, who_title
from wasp_cli.spec.study import QUESTIONS
from wasp_cli.store.people import timing_summary

MEASURES = tuple(
    Column(column.key, column.title, digits=column.digits, scale=column.scale)
    for column in PAPER_COLUMNS
    if column.key in ("return", "success", "cost", "int_rate")
)
LABELS = ("Task", "Condition")
ALONE = "human"
DIFFERENCES = (
    Column("return_change", "Return, to alone", signed=True),
    Column("cost_change", "Cost, to alone", signed=True),
)
TIMES = (
    Column("decisions", "Decisions", digits=0, spread=False),
    Column("late_share", "late (%)", digits=1, scale=100.0, spread=False),
    Column("decision_p50_ms", "decision (ms)", digits=1, spread=False),
    Column("decision_p99_ms", "p99", digits=1, spread=False),
    Column("input_age_p50_ms", "key to action (ms)", digits=0, spread=False),
    Column("input_age_p99_ms", "p99", digits=0, spread=False),
    Column("round_trip_p50_ms", "round trip (ms)", digits=1, spread=False),
    Column("round_trip_p99_ms", "p99", digits=1, spread=False),
    Column("pauses", "pauses", digits=0, spread=False),
    Column("cut", "cut", digits=0, spread=False),
    Column("lost", "lost", digits=0, spread=False),
)
SCALES = {WORKLOAD: "Raw TLX", **{name: name.capitalize() for scales in QUESTIONS.values() for name, *_ in scales}}


def people_tables(sittings: Sequence[Sitting]) -> list[Table]:
    """Make the tables of the cells that people drove; none where nobody drove."""
    if not sittings:
        return []
    groups: dict[tuple[str, str, str], list[Sitting]] = {}
    for each in sittings:
        groups.setdefault(condition_of(each), []).append(each)
    tables = [_measures(groups, sittings), _questions(groups, sittings), _order(sittings), _timing(groups, sittings)]
    return [table for table in tables if table.rows]


def people_fact(sittings: Sequence[Sitting]) -> str:
    """Say how many people drove, and how many of them were scripts."""
    people = len({each.participant for each in sittings})
    text = f"{len(sittings)} cells were driven by {people} participant{'' if people == 1 else 's'}."
    simulated = {each.participant for each in sittings if each.simulated}
    if simulated:
        whole = "All of them are" if len(simulated) == people else f"{len(simulated)} of them are"
        text += f" {whole} SIMULATED: scripts drove and answered, no people."
    return text


def late_facts(sittings: Sequence[Sitting]) -> list[str]:
    """Say of every condition in which the assistant was late how often it was: there the driver was alone."""
    found: Counter[tuple[str, str, str]] = Counter()
    decisions: Counter[tuple[str, str, str]] = Counter()
    for each in sittings:
        late = np.asarray(each.beats["late"], bool)
        found[condition_of(each)] += int(late.sum())
        decisions[condition_of(each)] += len(late)
    return [
        f"{' on '.join(reversed(_labels(condition)))}: late in {late} of {decisions[condition]} decisions, in which nobody assisted."
        for condition, late in found.items()
        if late and condition[1] != ALONE
    ]


def _labels(condition: tuple[str, str, str]) -> tuple[str, str]:
    task, method, variant = condition
    return task_title(task), who_title(method, variant)


def _notes(sittings: Sequence[Sitting]) -> tuple[str, ...]:
    return (
        people_fact(sittings),
        f"± is the standard deviation over participants, [low, high] a 95 % interval of {RESAMPLES} bootstrap means over them.",
    )


def _of(sittings: Sequence[Sitting], key: str) -> Value:
    return over_participants((each.participant, measured(each, key)) for each in sittings)


def _measures(groups: dict[tuple[str, str, str], list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    rows = []
    for condition, own in groups.items():
        alone = groups.get((condition[0], ALONE, "full"), [])
        changes = [UNDEFINED if condition[1] == ALONE else compared(own, alone, key) for key in ("return", "cost")]
        rows.append(Row(_labels(condition), (*(_of(own, column.key) for column in MEASURES), *changes)))
    meanings = ("To alone: mean difference to driving alone, of the same participant in the same worlds.",)
    columns, title = (*MEASURES, *DIFFERENCES), "People: measures by condition"
    return Table("people", title, LABELS, columns, tuple(rows), _notes(sittings), meanings, ranked=False)


def _questions(groups: dict[tuple[str, str, str], list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    """A row for each scale, a column for each condition."""
    asked = [scale for scale in SCALES if any(scale in each.answers for each in sittings)]
    names = list(dict.fromkeys(condition[1:] for condition in groups))
    columns = tuple(Column("_".join(name), who_title(*name), digits=0) for name in names)
    rows = []
    for task in dict.fromkeys(condition[0] for condition in groups):
        rows += [
            Row((task_title(task), SCALES[scale]), tuple(_of(groups.get((task, *name), []), scale) for name in names)) for scale in asked
        ]
    meanings = (
        "Scales from 0 to 100. Raw TLX is the mean of NASA's six: mental, physical and temporal demand, performance (0 is perfect), "
        "effort, frustration; more is more load. Agency, trust and satisfaction: more is more.",
    )
    return Table(
        "questionnaires", "People: answers by condition", ("Task", "Scale"), columns, tuple(rows), _notes(sittings), meanings, ranked=False
    )


def _order(sittings: Sequence[Sitting]) -> Table:
    """By place in the order: differences to the mean of the condition, so that conditions cancel out."""
    columns = [Column(column.key, column.title, digits=column.digits, scale=column.scale, signed=True) for column in MEASURES]
    if any(WORKLOAD in each.answers for each in sittings):
        columns.append(Column(WORKLOAD, SCALES[WORKLOAD], digits=1, signed=True))
    rows = []
    for task in dict.fromkeys(each.cell.identity.task for each in sittings):
        own = [each for each in sittings if each.cell.identity.task == task]
        found = {column.key: deviations(own, column.key) for column in columns}
        places = sorted({each.place for each in own if each.place is not None})
        if len(places) > 1:
            for place in places:
                values = tuple(
                    over_participants((each.participant, number) for each, number in found[column.key] if each.place == place)
                    for column in columns
                )
                rows.append(Row((task_title(task), str(place + 1)), values))
    notes = (*_notes(sittings), *_balance(sittings))
    meanings = ("Difference to the mean of the condition: what being driven first, second, ... changed, whichever condition it was.",)
    return Table("order", "People: effect of the order", ("Task", "Place"), tuple(columns), tuple(rows), notes, meanings, ranked=False)


def _balance(sittings: Sequence[Sitting]) -> tuple[str, ...]:
    """Say whether every condition stood in every place equally often."""
    placed = Counter((condition_of(each), each.place) for each in sittings if each.place is not None)
    cells = {condition for condition, _ in placed}, {place for _, place in placed}
    balanced = len(set(placed.values())) == 1 and len(placed) == len(cells[0]) * len(cells[1])
    return () if balanced else ("NOT BALANCED: not every condition stood in every place equally often.",)


def _timing(groups: dict[tuple[str, str, str], list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    rows = []
    counts: dict[str, Callable[[Sitting], int]] = {
        "pauses": lambda each: each.pauses, "cut": lambda each: each.cut, "lost": lambda each: each.lost,
    }  # fmt: skip
    for condition, own in groups.items():
        found = timing_summary(pa.concat_tables([_own_beats(each, number) for number, each in enumerate(own)]))
        found |= {name: sum(map(of, own)) for name, of in counts.items()}
        numbers = [found[column.key] for column in TIMES]
        people = len({each.participant for each in own})
        values = tuple(UNDEFINED if number is None else Value(float(number), n=people, ranked=False) for number in numbers)
        rows.append(Row(_labels(condition), values))
    meanings = (
        "late: the assistant had not answered in time, and the command was executed as it is. Key to action: from the "
        "arrival of a new key to the execution of the action that knows of it. Round trip: from a frame to its acknowledgement. "
        "cut: episodes that were given up; lost: connections that broke.",
    )
    return Table(
        "timing",
        "People: were decisions in time?",
        ("Task", "Condition"),
        TIMES,
        tuple(rows),
        (people_fact(sittings),),
        meanings,
        ranked=False,
    )


def _own_beats(sitting: Sitting, number: int) -> pa.Table:
    """The decisions of a cell; episodes of several cells are told apart, since a key of one is not held in the next."""
    episodes = np.asarray(sitting.beats["episode"]) + 1_000_000 * number
    where = sitting.beats.schema.get_field_index("episode")
    return sitting.beats.set_column(where, sitting.beats.schema.field("episode"), pa.array(episodes, pa.int32()))
