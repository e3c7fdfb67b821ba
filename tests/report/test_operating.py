"""Operating points in a report: who is silent, table and figure, and files that do not read."""

import io
import json
import shutil
from dataclasses import replace

import pytest
from rich.console import Console

from tests.report.explained import KEY, Invented, episode_text
from tests.report.invented import invent, write_rows
from wasp_cli.cells.asked import Asked
from wasp_cli.cells.cell import recorded_cell
from wasp_cli.plan.grid import cells_of
from wasp_cli.report.explain.episode import read_episode
from wasp_cli.report.operating import operating_figure, operating_table, read_operating, silences
from wasp_cli.report.summarize import report_run
from wasp_cli.run.numbers import numbers_line
from wasp_cli.spec.model import validate
from wasp_cli.spec.shipped import published_folder
from wasp_cli.store.artifact import read_manifest, stored_keys
from wasp_cli.store.find import FoundCell
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record

WASP, IDA = "a" * 16, "b" * 16
SENTENCE = (
    "WASP is silent on Goal1: on held-out worlds no setting of it helped (operators "
    "alone: return 11.2, cost 5.1; the best setting: 7.3, 4.0)."
)


def point(value, return_, cost, effective):
    means = {"return_": return_, "cost": cost, "effective": effective, "value": value}
    return {**means, "episodes": 4, "alone_return": 11.2, "alone_cost": 5.1}


def write_point(layout, key, method, document):
    """Write an artifact of the stage `operating`."""
    axes = {"method": method, "method_config": {}}
    record = {"task": "goal1", "seed": 0, "label": method, "kind": "operating", "axes": axes}
    write_record(
        layout.manifest("operating", key),
        {**record, "upstream": {}, "upstream_kinds": {}, "summary": {}, "provenance": {}},
    )
    folder = layout.artifact("operating", key)
    (folder / "operating_point.json").write_text(json.dumps(document))


@pytest.fixture
def run(layout):
    """A spec with its cells in a store: WASP is silent, and IDA is not."""
    spec = validate(
        {
            "name": "tiny",
            "preset": "smoke",
            "tasks": ["goal1"],
            "methods": ["human", "ida", "wasp"],
            "operators": {"noisy": {"mild": 0.2}},
            "seeds": [0],
            "episodes": 2,
            "operating_points": "chosen",
        }
    )
    silent, acts = point(0.5, 7.3, 4.0, 0.72), point(2.0, 13.0, 4.0, 0.3)
    write_point(
        layout,
        WASP,
        "wasp",
        {
            "method": "wasp",
            "knob": {"symbol": "tau_r, times"},
            "silent": True,
            "value": None,
            "best": silent,
            "points": [silent, point(1.0, 7.0, 4.1, 0.6)],
        },
    )
    write_point(
        layout,
        IDA,
        "ida",
        {
            "method": "ida",
            "knob": {"symbol": "tau_Q, times"},
            "silent": False,
            "value": 2.0,
            "best": acts,
            "points": [point(0.5, 9.0, 4.0, 0.5), acts],
        },
    )
    cells = []
    for number, planned in enumerate(cells_of(spec)):
        key = f"{number:016x}"
        cell = recorded_cell(layout, planned, key, spec.name)
        folder = layout.artifact("evaluate", key)
        folder.mkdir(parents=True)
        write_rows(folder, cell.identity, [invent(e, 12, 0.1, 0.02) for e in range(2)])
        upstream = {"wasp": {"operating": WASP}, "ida": {"operating": IDA}}.get(cell.method, {})
        record = {"task": "goal1", "seed": 0, "label": cell.label, "axes": {"method": cell.method}}
        kinds = {"upstream": upstream, "upstream_kinds": {name: name for name in upstream}}
        write_record(
            layout.manifest("evaluate", key),
            {**record, **kinds, "summary": {}, "provenance": {"seconds": 1.0}},
        )
        cells.append(cell)
    return Asked(layout, "run", spec, tuple(cells), ())


def test_the_report_says_who_is_silent_and_has_table_and_figure(run, layout):
    report = report_run(run)
    console = Console(width=400, file=io.StringIO(), record=True)
    report.terminal(console)
    assert SENTENCE in console.export_text()
    files = {path.name for path in report.write(layout.root / "out")}
    for ending in ("png", "svg", "md", "csv", "tex", "html"):
        assert f"operating_points.{ending}" in files
    for page in ("report.md", "report.html", "table1.tex"):
        text = (layout.root / "out" / page).read_text(encoding="utf-8")
        assert "WASP is silent on Goal1" in text
        assert "IDA is silent" not in text
    table = (layout.root / "out" / "operating_points.csv").read_text()
    assert "silent, chosen" in table
    assert "tau_Q, times 2, chosen" in table
    assert table.count("chosen") == 2


def test_a_spec_with_given_points_has_neither(run, layout):
    given = run.spec.model_copy(update={"operating_points": "given"})
    report = report_run(replace(run, spec=given))
    assert not any("silent" in fact for fact in report.facts)
    assert not [table for table in report.tables if table.name == "operating_points"]


@pytest.mark.parametrize("text", ["", "[]", '{"points": 3}', '{"method": "wasp", "knob": 1}'])
def test_what_does_not_read_is_left_out(text, run, layout):
    (layout.artifact("operating", WASP) / "operating_point.json").write_text(text)
    found = read_operating(layout, [cell.key for cell in run.cells])
    assert [each.method for each in found] == ["ida"]
    assert silences(found) == []


def test_the_point_behind_a_published_cell_is_that_of_the_published_layer(tmp_path):
    """A run copies the cell, and not what it was computed from."""
    published = Layout(published_folder())
    (key,) = [
        key
        for key in stored_keys(published, "evaluate")
        if read_manifest(published, "evaluate", key).get("label")
        == "CarRacing s0 diffusion noisy=0.4"
    ]
    here = Layout(tmp_path)
    shutil.copytree(published.artifact("evaluate", key), here.artifact("evaluate", key))
    (point,) = read_operating(here, [key])
    assert point.silent
    assert point.best.alone_return == pytest.approx(21.83, abs=0.01)


def test_nothing_is_drawn_of_nothing(tmp_path):
    assert operating_table([]) is None
    assert operating_figure([], tmp_path) == []


def test_the_line_at_the_end_of_a_node_says_what_was_chosen():
    assert numbers_line({"operating_point": "silent", "return": 7.25}) == "silent, return 7.25"
    assert numbers_line({"return": 7.25}) == "return 7.25"


@pytest.mark.parametrize("said", ["silent", "tau_r, times 0.5"])
def test_explain_names_the_operating_point_of_a_cell(said, tmp_path):
    made = Invented()
    manifest = {**made.manifest(), "summary": {"operating_point": said}}
    text = episode_text(read_episode(FoundCell(made.write(tmp_path), KEY, manifest), 0))
    assert f"operating point {said}" in " ".join(text.split())
    assert "operating point" not in episode_text(made.read(tmp_path))
