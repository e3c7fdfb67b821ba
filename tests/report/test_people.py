"""What a report says of the cells that people drove, against numbers that can be worked out by
hand.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from tests.report.made import frame_of_tables, one_cell, renamed
from wasp_cli.cells.table import CellTable
from wasp_cli.report.bootstrap import RESAMPLES, drawn
from wasp_cli.report.tables import Table, people
from wasp_cli.report.tables.main import severity_table
from wasp_cli.report.tables.people import (
    WORKLOAD,
    Sitting,
    compared,
    over_participants,
    people_fact,
    people_tables,
)
from wasp_cli.spec.study import QUESTIONS, balanced_order
from wasp_cli.store.layout import Layout
from wasp_cli.store.parquet import write_table
from wasp_cli.store.people import BEAT, SESSION_FILE, TIMING_FILE, timing_summary
from wasp_cli.store.tables import CellIdentity

METHODS = ("human", "ida", "diffusion", "wasp")
BETTER = {"human": 0.0, "ida": 3.0, "diffusion": 1.0, "wasp": 4.0}
LEARNT = 0.5
"""What every place adds."""


def beats(
    late: list[bool],
    inputs: list[int] | None = None,
    ages: list[float | None] | None = None,
    episode: int = 0,
) -> pa.Table:
    count = len(late)
    columns: dict[str, list[Any]] = {
        "episode": [episode] * count,
        "t": list(range(count)),
        "at": [0.08 * t for t in range(count)],
        "decision_ms": [10.0] * count,
        "late": late,
        "behind_ms": [0.0] * count,
        "rest_ms": [5.0] * count,
        "input": inputs or [0] * count,
        "input_age_ms": ages or [None] * count,
        "round_trip_ms": [1.0] * count,
        "keys": [""] * count,
        "focused": [True] * count,
    }
    return pa.table(
        {field.name: pa.array(columns[field.name], field.type) for field in BEAT}, schema=BEAT
    )


def sitting(
    participant: int,
    method: str,
    place: int,
    value: float,
    *,
    simulated: bool = False,
    answers: Any = None,
) -> Sitting:
    identity = CellIdentity("goal1", method, "full", "person", float(participant), 0)
    columns = {
        "return": [value],
        "success": [1.0],
        "cost": [2.0 * value],
        "int_rate": [0.1 * BETTER[method]],
    }
    cell = one_cell(identity, [0], f"p{participant}", **columns)
    return Sitting(cell, place, answers or {}, beats([False] * 8 + [True] * 2), simulated)


def study(participants: int = 8) -> list[Sitting]:
    """Every participant has a level of their own, every condition an effect, every place adds
    the same.
    """
    found = []
    for participant in range(1, participants + 1):
        for place, condition in enumerate(balanced_order(4, participant - 1)):
            method = METHODS[condition]
            scales = {name: 10.0 * participant for name, *_ in QUESTIONS["tlx"]}
            value = 10.0 + participant + BETTER[method] + LEARNT * place
            found.append(
                sitting(
                    participant,
                    method,
                    place,
                    value,
                    answers={WORKLOAD: 10.0 * participant, **scales, "trust": 50.0},
                )
            )
    return found


def table(tables: list[Table], name: str) -> Table:
    (found,) = (each for each in tables if each.name == name)
    return found


def value(found: Table, label: str, key: str) -> Any:
    row = next(row for row in found.rows if row.labels[1] == label)
    return row.values[[column.key for column in found.columns].index(key)]


def test_participants_are_the_unit() -> None:
    numbers = [(1, 2.0), (1, 4.0), (2, 5.0), (3, 10.0), (3, math.nan)]
    found = over_participants(numbers)
    means = np.array([3.0, 5.0, 10.0])
    assert (found.mean, found.sd, found.n) == (
        pytest.approx(6.0),
        pytest.approx(means.std(ddof=1)),
        3,
    )
    resampled = sorted(float(counts @ means) / 3 for counts in drawn(3))
    assert len(resampled) == RESAMPLES
    assert (found.interval.unit, found.interval.clusters) == ("participant", 3)
    np.testing.assert_allclose(
        [found.interval.low, found.interval.high],
        np.quantile(resampled, [0.025, 0.975]),
        atol=1e-12,
    )


def test_measures_by_condition_and_differences_to_driving_alone() -> None:
    found = table(people_tables(study()), "people")
    # Every condition stood twice in each place: what the places add is the same for all, 1.5 steps
    # on average.
    for method, title in (("human", "Human-only"), ("ida", "IDA"), ("wasp", "WASP")):
        assert value(found, title, "return").mean == pytest.approx(
            10 + 4.5 + BETTER[method] + 1.5 * LEARNT
        )
    assert value(found, "WASP", "return_change").mean == pytest.approx(4.0)
    assert value(found, "WASP", "cost_change").mean == pytest.approx(8.0)
    assert value(found, "Human-only", "return_change").mean is None
    sittings = study()
    own, alone = (
        [each for each in sittings if each.condition[1] == name] for name in ("wasp", "human")
    )
    by_hand = [
        a.cell.pooled("return")[0] - b.cell.pooled("return")[0]
        for a, b in zip(own, alone, strict=True)
    ]
    assert compared(own, alone, "return").sd == pytest.approx(np.std(by_hand, ddof=1))
    assert compared(own, alone[1:], "return").n == 7, "only who has both"


def test_the_effect_of_the_order_is_found_and_conditions_cancel_out() -> None:
    found = table(people_tables(study()), "order")
    assert [row.labels[1] for row in found.rows] == ["1", "2", "3", "4"]
    for place in range(4):
        assert value(found, str(place + 1), "return").mean == pytest.approx(LEARNT * (place - 1.5))
    assert not any("NOT BALANCED" in note for note in found.notes)
    assert sum(number for _, number in people.deviations(study(), "return")) == pytest.approx(0.0)
    # A second task is driven after the first, in places of its own.
    later = [replace(each, place=each.place + 4, cell=_on(each.cell, "race1")) for each in study()]
    assert not any(
        "NOT BALANCED" in note for note in table(people_tables(study() + later), "order").notes
    )
    assert any(
        "NOT BALANCED" in note for note in table(people_tables(study() + later[1:]), "order").notes
    )


def test_numbers_of_participants_are_no_severities() -> None:
    assert severity_table(frame_of_tables(*(each.cell for each in study()))) is None


def _on(cell: CellTable, task: str) -> CellTable:
    return renamed(cell, lambda _: {"task": task})


def test_answers_by_condition() -> None:
    found = table(people_tables(study()), "questionnaires")
    assert value(found, "Raw TLX", "wasp_full").mean == pytest.approx(45.0)
    assert value(found, "Trust", "ida_full").mean == 50.0
    assert "Agency" not in [row.labels[1] for row in found.rows], "nobody was asked"


def test_decisions_that_were_late_are_counted() -> None:
    found = table(people_tables(study()), "timing")
    assert value(found, "IDA", "decisions").mean == 80
    assert value(found, "IDA", "late_share").mean == pytest.approx(0.2)


def test_the_age_of_a_key_counts_where_it_is_new() -> None:
    """A key that is held for long is no slow one, and one of an earlier episode is not new in
    the next.
    """
    first = beats([False] * 4, [1, 1, 2, 2], [50.0, 130.0, 60.0, 140.0])
    second = beats([False] * 2, [2, 3], [9000.0, 70.0], episode=1)
    found = timing_summary(pa.concat_tables([first, second]))
    assert found["input_age_p50_ms"] == 65.0


def test_scripts_do_not_pass_for_people() -> None:
    people = [sitting(1, "human", 0, 1.0), sitting(2, "human", 0, 1.0)]
    assert people_fact(people) == "2 cells were driven by 2 participants."
    mixed = [people[0], sitting(2, "human", 0, 1.0, simulated=True)]
    assert "1 of them are SIMULATED" in people_fact(mixed)
    assert all(any("SIMULATED" in note for note in each.notes) for each in people_tables(mixed))
    assert people_tables([]) == []


@pytest.mark.parametrize(
    ("session", "said"),
    [
        ("{", "damaged"),
        ('{"block": [3]}', "is not as wasp writes it"),
        ('{"answers": {"tlx": 7}}', "is not as wasp writes it"),
        ("[]", ""),
        (None, "is missing"),
    ],
)
def test_damage_is_said_and_the_rest_is_read(
    tmp_path: Path, session: str | None, said: str
) -> None:
    whole, other = sitting(1, "human", 0, 1.0), sitting(2, "human", 0, 1.0)
    layout = Layout(tmp_path)
    for each, text in ((whole, json.dumps({"block": 1})), (other, session)):
        folder = layout.artifact("evaluate", each.cell.cells[0].key)
        folder.mkdir(parents=True)
        write_table(each.beats, folder / TIMING_FILE)
        if text is not None:
            (folder / SESSION_FILE).write_text(text)
    found, damaged = people.read_people(layout, frame_of_tables(whole.cell, other.cell))
    assert [(each.participant, each.place) for each in found] == [(1, 1)]
    assert len(damaged) == 1
    assert said in damaged[0]
