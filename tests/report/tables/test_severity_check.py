"""The table and the record of `wasp severities`, from cells on disk."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from tests.report.invented import write_returns
from wasp_cli.plan.grid import cells_of
from wasp_cli.plan.node import Cell
from wasp_cli.report.render import csv_text, markdown, terminal, write_pages
from wasp_cli.report.stats import Frame, Wanted
from wasp_cli.report.tables.severity_check import SeverityCheck, as_json, check_table, judge, judged, read_checks
from wasp_cli.spec.model import Spec, validate

RETURNS = {None: 12.0, 0.5: 10.0, 0.7: 8.0, 0.1: 5.0, 0.6: 6.0}
"""By severity value; seed s adds s, and the second episode 2."""


def spec_of(seeds: Sequence[int] = (0, 1, 2), tasks: Sequence[str] = ("goal1",)) -> Spec:
    # Not in the order of the alphabet, nor of the values.
    operators = {"noisy": {"strong": 0.6, "weak": 0.1}, "laggy": {"moderate": 0.7, "mild": 0.5}}
    return validate(
        {
            "name": "check", "preset": "smoke", "tasks": list(tasks), "methods": ["human", "expert"], "stages": [],
            "operators": operators, "seeds": list(seeds),
        }
    )  # fmt: skip


def written(spec: Spec, folder: Path, returns: Callable[[Cell], Sequence[float]]) -> list[Wanted]:
    """Write the cells of a spec with these returns."""
    wanted = []
    for i, cell in enumerate(cells_of(spec)):
        (folder / str(i)).mkdir(parents=True)
        wanted.append(write_returns(folder / str(i), cell, returns(cell)))
    return wanted


def read(
    spec: Spec, folder: Path, without: str = "nothing", returns: dict[float | None, float] = RETURNS
) -> tuple[list[SeverityCheck], Frame]:
    """Write the cells of a spec, all but those whose label holds `without`, and read them."""
    wanted = written(spec, folder, lambda cell: [returns[cell.value] + cell.seed + change for change in (-1, 1)])
    for cell in wanted:
        if without in cell.label:
            cell.path.unlink()
    return read_checks(spec, wanted)


def lines_of(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("| ")]


def test_the_expert_comes_first_and_severities_in_the_order_of_the_spec(tmp_path: Path) -> None:
    checks, frame = read(spec_of(), tmp_path)
    lines = lines_of(markdown(check_table(checks, frame)))
    assert lines[0] == "| Task | Operator | Severity | Return ↑ | of expert (%) | Succ. (%) ↑ | Cost ↓ | Viol. ↓ | Change | SE |"
    shown = [line.split("|")[2:6] for line in lines[2:]]
    # Over the seeds 0, 1 and 2 the mean is 1 more, and the SD is 1.
    assert [[text.strip() for text in row] for row in shown] == [
        ["Expert", "", "13.00 ± 1.00", "100.0"],
        ["Noisy", "strong 0.6", "7.00 ± 1.00", "53.8"],
        ["Noisy", "weak 0.1", "6.00 ± 1.00", "46.2"],
        ["Laggy", "moderate 0.7", "9.00 ± 1.00", "69.2"],
        ["Laggy", "mild 0.5", "11.00 ± 1.00", "84.6"],
    ]
    assert [line.split("|")[-3].strip() for line in lines[2:]] == ["n/a", "-6.00", "-1.00", "-4.00", "2.00"]
    assert [judge(check).outcome for check in checks] == ["accepted", "not accepted"]
    text = markdown(check_table(checks, frame))
    assert "- Noisy: how much it loses is not judged, since none of 2 severities is named moderate, and none is in the middle." in text
    assert "Laggy: how" not in text


def test_one_seed_has_no_spread_and_a_standard_error(tmp_path: Path) -> None:
    spec = spec_of(seeds=[3])
    checks, frame = read_checks(spec, written(spec, tmp_path, lambda cell: [8, 12] if cell.method == "expert" else [3, 5]))
    text = markdown(check_table(checks, frame))
    line = next(line for line in lines_of(text) if "strong" in line)
    # Less the expert: -5 and -7.
    assert line.startswith("|  | Noisy | strong 0.6 | 4.00 | 40.0 |")
    assert line.endswith("| -6.00 | 1.00 |")
    assert "One seed: no ±" in text


def test_missing_cells_are_marked_and_left_out_of_both_sides(tmp_path: Path) -> None:
    checks, frame = read(spec_of(), tmp_path, without="human laggy=0.7 seed 2")
    noisy, laggy = checks
    assert (judge(noisy).outcome, judge(laggy).outcome) == ("accepted", "incomplete")
    assert laggy.share(laggy.levels[0]) == pytest.approx(8.5 / 12.5)  # of the expert's seeds 0 and 1 alone
    change = laggy.changes()[0]
    assert (change.mean, change.pairs) == (-4.0, 4)
    text = markdown(check_table(checks, frame))
    assert "| Laggy | moderate 0.7 [2 of 3 cells] | 8.50 ± 0.71 | 68.0 |" in text
    assert "INCOMPLETE: 1 of 15 cells are missing" in text
    record = as_json("check", checks, frame)
    assert record["missing"] == [{"cell": "goal1 human laggy=0.7 seed 2", "reason": "not computed yet"}]


def test_without_the_expert_every_operator_of_the_task_is_incomplete(tmp_path: Path) -> None:
    checks, frame = read(spec_of(seeds=[0], tasks=["goal1", "race1"]), tmp_path, without="race1 expert")
    outcomes = [(check.task, judge(check).outcome) for check in checks]
    assert outcomes == [("goal1", "accepted"), ("goal1", "not accepted"), ("race1", "incomplete"), ("race1", "incomplete")]
    lines = lines_of(markdown(check_table(checks, frame)))
    assert [line for line in lines if "Expert" in line][1].startswith("| Race1 | Expert | [0 of 1 cells] | n/a | n/a |")
    assert len(lines) == 2 + 2 * 5
    json.dumps(as_json("check", checks, frame), allow_nan=False)


def test_nothing_computed_is_a_table_too(tmp_path: Path) -> None:
    checks, frame = read(spec_of(), tmp_path, without="")
    text = markdown(check_table(checks, frame))
    assert "No cell has been computed yet" in text
    assert {judge(check).outcome for check in checks} == {"incomplete"}
    json.dumps(as_json("check", checks, frame), allow_nan=False)


def test_an_expert_without_return_is_said(tmp_path: Path) -> None:
    checks, frame = read(spec_of(seeds=[0]), tmp_path, returns={**RETURNS, None: -3.0})
    table = check_table(checks, frame)
    assert "- Goal1: the expert's return is not positive, so that no share of it is defined." in markdown(table)
    assert {row["share"] for row in csv.DictReader(StringIO(csv_text(table)))} == {""}


def test_two_severities_of_one_value_are_two_rows(tmp_path: Path) -> None:
    spec = validate({**spec_of().model_dump(mode="json"), "operators": {"laggy": {"mild": 0.7, "moderate": 0.7}}})
    (found,), frame = read(spec, tmp_path)
    assert judge(found).reason.startswith("stays at 9.0 from mild 0.7 to moderate 0.7")
    assert len(lines_of(markdown(check_table([found], frame)))) == 2 + 3


def test_the_record_has_every_number_and_verdict(tmp_path: Path) -> None:
    checks, frame = read(spec_of(), tmp_path)
    record = as_json("check", checks, frame)
    (task,) = record["tasks"]
    assert (record["spec"], record["missing"], task["task"]) == ("check", [], "goal1")
    assert (task["expert"]["return"], task["expert"]["return_sd"], task["expert"]["episodes"]) == (13.0, 1.0, 6)
    noisy, laggy = task["operators"]
    assert (noisy["operator"], noisy["outcome"], noisy["moderate"], noisy["above"]) == ("noisy", "accepted", None, None)
    assert (laggy["outcome"], laggy["moderate"], laggy["kept_at_most"]) == ("not accepted", "moderate", 0.75)
    assert laggy["reason"].startswith("rises from 9.0 (moderate 0.7) to 11.0 (mild 0.5), 2.0 +- 0")
    assert laggy["above"]["mean"] == pytest.approx(9 - 0.75 * 13)
    moderate, mild = laggy["severities"]
    assert (moderate["severity"], moderate["value"], moderate["share"]) == ("moderate", 0.7, pytest.approx(9 / 13))
    assert mild["change"] == {"mean": 2.0, "se": 0.0, "pairs": 6}
    assert {"success", "cost", "viol", "viol_sd"} <= mild.keys()


def test_files_have_the_verdicts_and_the_terminal_has_room_at_80_columns(tmp_path: Path) -> None:
    checks, frame = read(spec_of(), tmp_path)
    table = check_table(checks, frame)
    files = write_pages(tmp_path, {}, [judged(table, checks)])
    pages = {path.name: path.read_text(encoding="utf-8") for path in files}
    assert set(pages) == {"severity_check.md", "severity_check.csv", "severity_check.tex", "severity_check.html"}
    assert "- goal1 noisy: accepted: falls at every step; " in pages["severity_check.md"]
    assert pages["severity_check.csv"].startswith("task,operator,severity,return,return_sd,share,success,")
    console = Console(width=80, file=StringIO(), record=True)
    console.print(terminal(table, 80))
    shown = console.export_text()
    assert max(map(len, shown.splitlines())) <= 80
    assert "moderate 0.7" in shown
    assert "-4.00" in shown


def test_only_a_readable_cell_counts(tmp_path: Path) -> None:
    spec = spec_of(seeds=[0])
    wanted = written(spec, tmp_path, lambda cell: [5, 6])
    wanted[0].path.write_bytes(b"PAR1")
    checks, frame = read_checks(spec, wanted)
    assert [judge(check).outcome for check in checks] == ["incomplete", "not accepted"]
    assert "is damaged" in frame.missing[0].reason
