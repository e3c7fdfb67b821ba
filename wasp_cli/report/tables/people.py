"""What people did in the cells that they drove: measures and answers by condition, the effect of
the order, whether decisions were in time.

The unit of every spread is the participant: episodes of one person are not independent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from wasp_cli.cells.table import CellTable
from wasp_cli.errors import ArtifactError, StoreError
from wasp_cli.operators.registry import PERSON
from wasp_cli.report.bootstrap import RESAMPLES, drawn, limits_of
from wasp_cli.report.stats import Frame, row_of
from wasp_cli.report.summary import UNDEFINED, Interval, Value, over_seeds
from wasp_cli.report.tables import Column, Row, Table, task_title, who_title
from wasp_cli.report.tables.main import PAPER_COLUMNS
from wasp_cli.spec.study import QUESTIONS
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.people import SESSION_FILE, TIMING_FILE, read_timing, timing_summary
from wasp_cli.store.records import read_record

TLX = "tlx"
WORKLOAD = "raw_tlx"  # mean of the six scales of NASA's task load index, without weights

Condition = tuple[str, str, str]  # task, method and ablation


@dataclass(frozen=True, eq=False)
class Sitting:
    """A cell that a person drove, with what they answered and when they decided."""

    cell: CellTable  # the single one
    place: int | None  # of its block in the participant's order, from 0
    answers: Mapping[str, float]  # by scale; with RAW TLX, where all six were answered
    beats: pa.Table  # a row per decision (`store.people.BEAT`)
    simulated: bool  # a script drove

    @property
    def task(self) -> str:
        """Where they drove."""
        return self.cell.cells[0].task

    @property
    def participant(self) -> int:
        """The number of who drove."""
        return int(self.cell.cells[0].value or 0)

    @property
    def seed(self) -> int:
        """The seed of its cell."""
        return self.cell.cells[0].seed

    @property
    def condition(self) -> Condition:
        """What the participant drove with: task, method and ablation."""
        return row_of(self.cell.cells[0])


def read_people(layout: Layout, frame: Frame) -> tuple[list[Sitting], list[str]]:
    """Read the sessions of the cells that people drove, and what is wrong with those that do not
    read.
    """
    sittings: list[Sitting] = []
    damaged: list[str] = []
    for place, cell in enumerate(frame.cells):
        if cell.operator != PERSON:
            continue
        folder = layout.artifact(KIND, cell.key)
        try:
            sittings.append(_sitting(frame.cells.choose([place]), folder))
        except (StoreError, ArtifactError) as error:
            damaged.append(error.message)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            damaged.append(f"{folder / SESSION_FILE} is not as wasp writes it: {error}")
    return sittings, damaged


def _sitting(cell: CellTable, folder: Path) -> Sitting:
    session = read_record(folder / SESSION_FILE)
    if session is None:
        raise StoreError(f"{folder / SESSION_FILE} is missing")
    place = session.get("block")
    return Sitting(
        cell,
        None if place is None else int(place),
        _answers(session.get("answers", {})),
        read_timing(folder / TIMING_FILE),
        bool(session.get("simulated", False)),
    )


def _answers(given: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    answers: dict[str, float] = {}
    tlx = [float(value) for value in given.get(TLX, {}).values()]
    if len(tlx) == 6:
        answers[WORKLOAD] = float(np.mean(tlx))
    for scales in given.values():
        answers |= {scale: float(value) for scale, value in scales.items()}
    return answers


def over_participants(numbers: Iterable[tuple[int, float]]) -> Value:
    """Return the mean over participants of their means, its standard deviation over them, and
    percentiles of bootstrap means.
    """
    own: dict[int, list[float]] = {}
    for participant, number in numbers:
        if not math.isnan(number):
            own.setdefault(participant, []).append(number)
    means = np.array([np.mean(own[participant]) for participant in sorted(own)])
    limits = limits_of(drawn(len(means)) @ means / len(means)) if len(means) > 1 else None
    interval = None if limits is None else Interval(*limits, "participant", len(means))
    return replace(over_seeds(means.tolist(), ranked=False), interval=interval)


def measured(sitting: Sitting, key: str) -> float:
    """Return an answer or a measure of a cell; NaN where the cell leaves it undefined."""
    if key in sitting.answers:
        return float(sitting.answers[key])
    return float(sitting.cell.pooled(key)[0])


def compared(own: Sequence[Sitting], reference: Sequence[Sitting], key: str) -> Value:
    """Return the mean difference to a reference, in pairs of one participant and one seed."""
    other = {(each.participant, each.seed): measured(each, key) for each in reference}
    pairs = [
        (
            each.participant,
            measured(each, key) - other.get((each.participant, each.seed), math.nan),
        )
        for each in own
    ]
    return over_participants(pairs)


def deviations(sittings: Sequence[Sitting], key: str) -> list[tuple[Sitting, float]]:
    """Return each cell's difference to the mean of its condition on its task, so that places
    can be compared: NaN where undefined.
    """
    conditions: dict[Condition, list[float]] = {}
    for each in sittings:
        number = measured(each, key)
        if not math.isnan(number):
            conditions.setdefault(each.condition, []).append(number)
    return [
        (each, measured(each, key) - float(np.mean(conditions.get(each.condition, [math.nan]))))
        for each in sittings
    ]


MEASURES = tuple(
    replace(column, better=None)
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
)
SCALES = {
    WORKLOAD: "Raw TLX",
    **{name: name.capitalize() for scales in QUESTIONS.values() for name, *_ in scales},
}


def people_tables(sittings: Sequence[Sitting]) -> list[Table]:
    """Return the tables of cells that people drove: measures, answers, order, times. Those without
    rows are left out.
    """
    if not sittings:
        return []
    groups: dict[Condition, list[Sitting]] = {}
    for each in sittings:
        groups.setdefault(each.condition, []).append(each)
    tables = [
        _measures(groups, sittings),
        _questions(groups, sittings),
        _order(sittings),
        _timing(groups, sittings),
    ]
    return [table for table in tables if table.rows]


def people_fact(sittings: Sequence[Sitting]) -> str:
    """Say how many participants drove how many cells, and how many of them were scripts."""
    people = len({each.participant for each in sittings})
    text = f"{len(sittings)} cells were driven by {people} participant{'' if people == 1 else 's'}."
    simulated = {each.participant for each in sittings if each.simulated}
    if simulated:
        whole = "All of them are" if len(simulated) == people else f"{len(simulated)} of them are"
        text += f" {whole} SIMULATED: scripts drove and answered, no people."
    return text


def late_facts(sittings: Sequence[Sitting]) -> list[str]:
    """Say in how many decisions an assistant was late; nothing of one that never was."""
    late_counts: Counter[Condition] = Counter()
    decisions: Counter[Condition] = Counter()
    for each in sittings:
        late = np.asarray(each.beats["late"], bool)
        late_counts[each.condition] += int(late.sum())
        decisions[each.condition] += len(late)
    return [
        f"{' on '.join(reversed(_labels(condition)))}: late in {late} of "
        f"{decisions[condition]} decisions, in which nobody assisted."
        for condition, late in late_counts.items()
        if late and condition[1] != ALONE
    ]


def _labels(condition: Condition) -> tuple[str, str]:
    task, method, variant = condition
    return task_title(task), who_title(method, variant)


def _notes(sittings: Sequence[Sitting]) -> tuple[str, ...]:
    count = len({each.participant for each in sittings})
    limits = (
        f", [low, high] the {Interval(0.0, 0.0, 'participant', count).words}, of "
        f"{RESAMPLES} bootstrap means"
        if count > 1
        else ""
    )
    return people_fact(sittings), f"± is the standard deviation over participants{limits}."


def _of(sittings: Sequence[Sitting], key: str) -> Value:
    return over_participants((each.participant, measured(each, key)) for each in sittings)


def _measures(groups: dict[Condition, list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    rows = []
    for condition, own in groups.items():
        alone = groups.get((condition[0], ALONE, "full"), [])
        changes = [
            UNDEFINED if condition[1] == ALONE else compared(own, alone, key)
            for key in ("return", "cost")
        ]
        rows.append(
            Row(_labels(condition), (*(_of(own, column.key) for column in MEASURES), *changes))
        )
    meanings = (
        "To alone: mean difference to driving alone, of the same participant in the same worlds.",
    )
    columns, title = (*MEASURES, *DIFFERENCES), "People: measures by condition"
    return Table(
        "people", title, LABELS, columns, tuple(rows), _notes(sittings), meanings, ranked=False
    )


def _questions(groups: dict[Condition, list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    asked = [scale for scale in SCALES if any(scale in each.answers for each in sittings)]
    names = list(dict.fromkeys(condition[1:] for condition in groups))
    columns = tuple(Column("_".join(name), who_title(*name), digits=0) for name in names)
    rows = []
    for task in dict.fromkeys(condition[0] for condition in groups):
        rows += [
            Row(
                (task_title(task), SCALES[scale]),
                tuple(_of(groups.get((task, *name), []), scale) for name in names),
            )
            for scale in asked
        ]
    meanings = (
        "Scales from 0 to 100. Raw TLX is the mean of NASA's six: mental, physical and "
        "temporal demand, performance (0 is perfect), "
        "effort, frustration; more is more load. Agency, trust and satisfaction: more is more.",
    )
    return Table(
        "questionnaires",
        "People: answers by condition",
        ("Task", "Scale"),
        columns,
        tuple(rows),
        _notes(sittings),
        meanings,
        ranked=False,
    )


def _order(sittings: Sequence[Sitting]) -> Table:
    columns = [replace(column, signed=True) for column in MEASURES]
    if any(WORKLOAD in each.answers for each in sittings):
        columns.append(Column(WORKLOAD, SCALES[WORKLOAD], digits=1, signed=True))

    # A row for each task and place: what differs from the mean of the condition.
    rows: list[Row] = []
    balanced = True
    for task in dict.fromkeys(each.task for each in sittings):
        own = [each for each in sittings if each.task == task]
        changes = {column.key: deviations(own, column.key) for column in columns}
        places = sorted({each.place for each in own if each.place is not None})
        if len(places) > 1:
            for place in places:
                values = tuple(
                    over_participants(
                        (each.participant, number)
                        for each, number in changes[column.key]
                        if each.place == place
                    )
                    for column in columns
                )
                rows.append(Row((task_title(task), str(place + 1)), values))

        # Balanced: every condition stood in every place, equally often.
        placed = Counter((each.condition, each.place) for each in own if each.place is not None)
        conditions = {condition for condition, _ in placed}
        places_there = {place for _, place in placed}
        pairs = len(conditions) * len(places_there)
        balanced &= len(set(placed.values())) == 1 and len(placed) == pairs

    notes = list(_notes(sittings))
    if not balanced:
        notes.append("NOT BALANCED: not every condition stood in every place equally often.")
    meanings = (
        "Difference to the mean of the condition: what being driven first, second, ... "
        "changed, whichever condition it was.",
    )
    return Table(
        "order",
        "People: effect of the order",
        ("Task", "Place"),
        tuple(columns),
        tuple(rows),
        tuple(notes),
        meanings,
        ranked=False,
    )


def _timing(groups: dict[Condition, list[Sitting]], sittings: Sequence[Sitting]) -> Table:
    rows = []
    for condition, own in groups.items():
        beats = pa.concat_tables([each.beats for each in own])
        # Episodes of several cells are told apart, since a key of one is not held in the next.
        cell = np.repeat(np.arange(len(own)), [each.beats.num_rows for each in own])
        episodes = pa.array(np.asarray(beats["episode"]) + 1_000_000 * cell, pa.int32())
        summary = timing_summary(
            beats.set_column(beats.schema.get_field_index("episode"), "episode", episodes)
        )
        numbers = [summary[column.key] for column in TIMES]
        people = len({each.participant for each in own})
        values = tuple(
            UNDEFINED if number is None else Value(float(number), n=people, ranked=False)
            for number in numbers
        )
        rows.append(Row(_labels(condition), values))
    meanings = (
        "late: the assistant had not answered in time, and the command was executed as it "
        "is. Key to action: from the "
        "arrival of a new key to the execution of the action that knows of it.",
    )
    return Table(
        "timing",
        "People: were decisions in time?",
        LABELS,
        TIMES,
        tuple(rows),
        (people_fact(sittings),),
        meanings,
        ranked=False,
    )
