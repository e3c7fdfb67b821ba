import hashlib
import io
import json
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from tests.report.branched import invent_branches
from tests.report.invented import SKILL, invent, write_rows
from wasp_cli.cells.asked import Asked, asked_of_grid
from wasp_cli.cells.cell import recorded_cell
from wasp_cli.plan.grid import cells_of, lay_out
from wasp_cli.plan.keys import libraries
from wasp_cli.plan.node import Part
from wasp_cli.plan.plan import plan_against
from wasp_cli.plan.source import source_hashes
from wasp_cli.report.provenance import assumptions_in_force
from wasp_cli.report.stats import Frame
from wasp_cli.report.summarize import TABLES, Report, report_run
from wasp_cli.report.tables.main import ablation_table
from wasp_cli.spec.model import Spec, validate
from wasp_cli.spec.paper import load_paper
from wasp_cli.store.branches import BRANCHES_FILE
from wasp_cli.store.layout import Layout
from wasp_cli.store.records import write_record
from wasp_cli.store.tables import EPISODES_FILE


def key(kind: str, number: int) -> str:
    return hashlib.sha256(f"{kind} {number}".encode()).hexdigest()[:16]


@pytest.fixture
def spec() -> Spec:
    grid = {
        "tasks": ["goal1"],
        "methods": ["human", "wasp", "expert"],
        "operators": {"noisy": {"mild": 0.2, "severe": 0.6}},
    }
    return validate({"name": "tiny", "preset": "smoke", **grid, "seeds": [0, 1], "episodes": 2})


@pytest.fixture
def asked(spec: Spec, layout: Layout) -> Asked:
    """A store with every cell of the spec and the artifacts behind them."""
    cells = [
        recorded_cell(layout, cell, key("evaluate", number), spec.name)
        for number, cell in enumerate(cells_of(spec))
    ]
    for cell in cells:
        name = cell.key
        goals, intervene, risk = SKILL.get(cell.method, (12, 0.0, 0.02))
        folder = layout.artifact("evaluate", name)
        folder.mkdir(parents=True)
        write_rows(
            folder, cell.identity, [invent(e + cell.seed, goals, intervene, risk) for e in range(2)]
        )
        upstream = {"world_model": key("world_model", cell.seed)}
        if cell.method == "wasp":
            upstream["calibration"] = key("calibration", cell.seed)
        manifest(layout, "evaluate", name, cell.seed, upstream, {"method": cell.method})
    for seed in spec.seeds:
        manifest(
            layout,
            "expert",
            key("expert", seed),
            seed,
            {},
            summary={"note": "<img src=https://e.example/x>"},
        )
        trained = {"expert": key("expert", seed)}
        manifest(
            layout,
            "world_model",
            key("world_model", seed),
            seed,
            trained,
            summary={"cost_auprc": 0.51234},
        )
        judge = {"world_model": key("world_model", seed)}
        manifest(
            layout, "diagnostics", key("diagnostics", seed), seed, judge, summary={"auprc@5": 0.4}
        )
        manifest(
            layout,
            "calibration",
            key("calibration", seed),
            seed,
            {"world_model": key("world_model", seed)},
            {"method": "wasp"},
        )
    return Asked(layout, "run", spec, tuple(cells), ())


def with_parts(asked: Asked) -> Asked:
    kinds = ("expert", "world_model", "critics", "diagnostics")
    parts = [
        (Part("goal1", kind, seed), key(kind, seed)) for seed in asked.spec.seeds for kind in kinds
    ]
    return replace(asked, parts=tuple(parts))


def manifest(
    layout: Layout,
    kind: str,
    name: str,
    seed: int,
    upstream: dict[str, str],
    axes: Any = (),
    summary: Any = (),
) -> None:
    kinds = {part: part for part in upstream}
    record = {
        "task": "goal1",
        "label": kind,
        "seed": seed,
        "upstream": upstream,
        "upstream_kinds": kinds,
        "axes": dict(axes),
    }
    write_record(
        layout.manifest(kind, name),
        {**record, "summary": dict(summary), "provenance": {"seconds": 65.2}},
    )


def terminal(report: Report, width: int = 140) -> str:
    console = Console(width=width, file=io.StringIO(), record=True)
    report.terminal(console)
    return console.export_text()


def test_complete(asked: Asked, layout: Layout) -> None:
    report, out = report_run(asked), layout.root / "out"
    assert not report.missing
    assert [artifact.stage for artifact in report.trained] == ["expert", "world_model"] * 2 + [
        "calibration of WASP"
    ] * 2
    out.mkdir()
    (out / "order.md").write_text("of a person")
    (out / "notes").symlink_to(layout.root)
    (out / "figure3.svg").symlink_to(layout.root / "read as a figure")
    files = report.write(out)
    assert {path.name for path in out.iterdir()} == {path.name for path in files} | {
        "notes",
        "order.md",
    }
    (out / "table2.csv").write_text("of an earlier report")
    assert report.write(out) == files
    assert not (out / "table2.csv").exists()
    assert all(path.is_file() and path.stat().st_size for path in files)
    assert [path.name for path in files[:2]] == ["report.md", "report.html"]
    endings = ("md", "csv", "tex", "html")
    assert {*(f"table1.{ending}" for ending in endings), "cost_return.png", "cost_return.svg"} <= {
        path.name for path in files
    }
    page = files[0].read_text(encoding="utf-8")
    for text in (
        "10 of 10 cells, 20 episodes",
        "cost_auprc 0.5123",
        "1 min 05 s",
        "](cost_return.png)",
        "`wasp.tau_c`",
        "&lt;img",
    ):
        assert text in page
    # Of two specs a label means the newest run's cell, a key always the same.
    assert all(
        f">{place}{asked.cells[0].key[:8]}" in files[1].read_text()
        for place in ("wasp explain ", "/cell/")
    )
    assert "`ida.vote`" not in page  # IDA is not in this spec
    assert "Missing" not in page
    text = terminal(report)
    assert "Human-only" in text
    assert "missing" not in text


def test_a_run_without_cells_reports_what_it_trained(asked: Asked, layout: Layout) -> None:
    write_record(layout.failure(key("critics", 1)), {"message": "no data", "log": "x.log"})
    report = report_run(replace(with_parts(asked), cells=()))
    assert (report.missing, [table.name for table in report.tables]) == (
        (),
        ["training", "world_model"],
    )
    assert [artifact.stage for artifact in report.trained] == [
        "expert",
        "world_model",
        "diagnostics",
    ] * 2
    page, text = report.markdown(), terminal(report)
    assert "- Training only: the spec lists no methods." in page
    for shown in (
        "Goal1",
        "1 [2 of 4 parts]",
        "2 of 8 parts are missing: goal1 s1 critics (failed: no data (log: x.log)), goal1 "
        "s0 critics",
    ):
        assert shown in page
        assert shown in text
    assert "Main results" not in page
    tables = {
        f"{name}.{ending}"
        for name in ("training", "world_model")
        for ending in ("md", "csv", "tex", "html")
    }
    assert {path.name for path in report.write(layout.root / "out")} == {
        "report.md",
        "report.html",
    } | tables


def test_missing_cells_are_named_with_their_reason(asked: Asked, layout: Layout) -> None:
    (layout.artifact("evaluate", asked.cells[0].key) / EPISODES_FILE).unlink()
    (layout.artifact("evaluate", asked.cells[1].key) / EPISODES_FILE).unlink()
    write_record(
        layout.failure(asked.cells[1].key),
        {"message": "TrainingError: no data", "log": "results/x.log"},
    )
    report = report_run(asked)
    page, text = report.markdown(), terminal(report)
    for named in (
        "goal1 human noisy=0.2 seed 0: not computed yet",
        "goal1 human noisy=0.2 seed 1: failed: TrainingError: no data (log: results/x.log)",
    ):
        assert named in page
        assert named in text
    assert "Human-only [2 of 4 cells]" in page


@pytest.mark.parametrize(
    ("text", "fact"), [("{", "is damaged"), ("{}", "is damaged: no 'upstream'")]
)
def test_a_damaged_manifest_is_a_fact_not_a_crash(
    text: str, fact: str, asked: Asked, layout: Layout
) -> None:
    layout.manifest("expert", key("expert", 0)).write_text(text, encoding="utf-8")
    report = report_run(asked)
    assert fact in report.facts[-1]
    assert [artifact.stage for artifact in report.trained].count("expert") == 1


def test_values_that_differ_from_the_paper_are_listed_beside_those_that_it_leaves_open(
    spec: Spec,
) -> None:
    found = {name: (value, why) for name, value, why in assumptions_in_force(spec)}
    assert found["wasp.candidates"] == (8, "differs from the paper, which has 300: N, section 5.1")
    assert "wasp.horizon" not in found  # 15, as in the paper
    assert "wasp.tau_c" in found
    # no settings, and told all the same
    assert {found[name][0] for name in ("the filter", "wasp: step k")} == {"mode", "k + 1"}
    assert found["world_model.free_nats"][1].startswith("differs from the paper: ")
    differs = [why.startswith("differs from the paper") for _, why in found.values()]
    assert differs == sorted(differs, reverse=True)  # what differs comes first


def branched(asked: Asked) -> Asked:
    """The same, with invented branches of the cells of WASP."""
    layout = asked.layout
    cells = []
    for number, cell in enumerate(asked.cells):
        if cell.method != "wasp":
            cells.append(cell)
            continue
        name = key("counterfactual", number)
        rows = layout.artifact("evaluate", cell.key) / EPISODES_FILE
        invent_branches(rows, cell.identity, layout.artifact("counterfactual", name))
        upstream = {"evaluate": cell.key}
        manifest(layout, "counterfactual", name, cell.seed, upstream, {"method": "wasp"})
        cells.append(replace(cell, branches=name))
    return replace(asked, cells=tuple(cells))


def test_figures_are_drawn_again_only_where_the_report_says_something_else(
    asked: Asked, layout: Layout
) -> None:
    out = layout.root / "out"
    first = report_run(asked).write(out)
    figure = out / "cost_return.png"
    figure.write_bytes(b"drawn before")
    assert report_run(asked).write(out, redraw=False) == first
    assert figure.read_bytes() == b"drawn before"
    report_run(replace(asked, cells=asked.cells[:-1])).write(out, redraw=False)
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_a_report_judges_the_interventions_and_names_the_cells_that_it_cannot_judge(
    asked: Asked, layout: Layout
) -> None:
    judged = branched(asked)
    whole = report_run(judged)
    assert not whole.missing
    assert [artifact.stage for artifact in whole.trained] == [
        artifact.stage for artifact in report_run(asked).trained
    ]
    assert all(
        "Were the interventions necessary?" in page for page in (whole.markdown(), whole.html())
    )

    first, second, *_ = (cell.branches for cell in judged.cells if cell.branches is not None)
    layout.artifact("counterfactual", first).joinpath(BRANCHES_FILE).unlink()
    layout.artifact("counterfactual", second).joinpath(BRANCHES_FILE).unlink()
    record = {
        "label": "goal1 s1 counterfactual wasp noisy=0.2",
        "message": "no room",
        "log": "x.log",
    }
    write_record(layout.failure(second), record)
    report = report_run(judged)
    assert not report.frame.missing
    assert [gap.key for gap in report.missing] == [first, second]
    told = terminal(report)
    assert "2 of 4 sets of counterfactual branches are missing:" in told
    assert "counterfactual of goal1 wasp noisy=0.2 seed 1: failed: no room (log: x.log)" in told
    assert "WASP [2 of 4 cells]" in told
    assert "counterfactual of goal1 wasp noisy=0.2 seed 0: not computed yet" in report.markdown()


def test_every_table_that_a_report_can_have_is_known(
    asked: Asked, layout: Layout, frame: Frame
) -> None:
    ablations = ablation_table(frame)
    judged = branched(asked)
    tables = report_run(with_parts(judged), load_paper()).tables
    names = {table.name for table in tables} | {ablations.name}
    # Those of people need people: tests/drive/test_study.py. The cells here have no predictions and
    # no operating points: tests/report/test_gains.py, tests/report/test_operating.py.
    elsewhere = {"people", "questionnaires", "order", "timing", "gains", "operating_points"}
    assert names == set(TABLES) - elsewhere


def test_a_damaged_failure_is_named_and_the_report_goes_on(asked: Asked, layout: Layout) -> None:
    (layout.artifact("evaluate", asked.cells[0].key) / EPISODES_FILE).unlink()
    layout.failure(asked.cells[0].key).write_text("{")
    report = report_run(asked)
    (missing,) = report.missing
    assert "is damaged" in missing.reason
    assert len(report.damaged) == 1
    assert str(layout.failure(asked.cells[0].key)) in report.damaged[0]
    assert report.damaged[0] in report.facts


def test_a_blocked_cell_names_what_blocks_it(spec: Spec, layout: Layout) -> None:
    grid = lay_out(spec)
    expert = next(node for node in grid.nodes if node.kind == "expert" and node.seed == 0)
    write_record(layout.failure(expert.key), {"message": "the loss is not finite", "log": "x.log"})
    write_record(
        layout.run("20260501-120000-tiny-0000") / "plan.json",
        {"spec": "tiny", **plan_against(grid, layout).as_json()},
    )
    report = report_run(asked_of_grid(layout, "run", spec, grid))
    reasons = {cell.label: cell.reason for cell in report.missing}
    blocked = "blocked by goal1 s0 expert, which failed: the loss is not finite (log: x.log)"
    assert reasons["goal1 human noisy=0.2 seed 0"] == blocked
    assert reasons["goal1 wasp noisy=0.6 seed 0"] == blocked
    assert reasons["goal1 human noisy=0.2 seed 1"] == "not computed yet"


MODULE = "wasp_cli.tasks.goal.task"


def import_artifact(layout: Layout, kind: str, name: str, **changes: Any) -> None:
    """Make an artifact one that was published: under today's code, but for changes."""
    record = json.loads(layout.manifest(kind, name).read_text())
    provenance = {
        "published": True,
        "wasp": "0.9",
        "git": {"sha": "abcdef0123"},
        "started_at": "2026-01-02T03:04:05",
    }
    provenance |= {"versions": libraries()}
    sources = source_hashes([MODULE]) | changes.pop("sources", {})
    record |= {
        "kind": kind,
        "label": f"{kind} {name[:4]}",
        "sources": sources,
        "provenance": record["provenance"] | provenance,
    }
    write_record(layout.manifest(kind, name), record | changes)


def test_published_results_are_counted_and_their_code_is_compared(
    asked: Asked, layout: Layout
) -> None:
    for cell in asked.cells[:2]:
        import_artifact(layout, "evaluate", cell.key)
    report = report_run(asked)
    # Ten cells, and behind them two experts, two world models and two calibrations.
    today = "their own code and libraries are the present ones"
    assert report.published == (
        "2 of 16 results here are published ones (2 evaluate), computed by wasp 0.9 (git "
        f"abcdef0) on 2026-01-02; {today}.",
        f"Published cells: evaluate {asked.cells[0].key[:4]}, evaluate {asked.cells[1].key[:4]}.",
    )
    import_artifact(
        layout,
        "world_model",
        key("world_model", 0),
        sources={MODULE: "before", "wasp_cli.gone": "before"},
    )
    report = report_run(asked)
    assert (
        "3 of 16 results here are published ones (1 world_model, 2 evaluate)" in report.published[0]
    )
    assert report.published[0].endswith(f"; changed since then: wasp_cli.gone, {MODULE}.")
    assert set(report.published) <= set(report.facts)
    assert report.published[0] in report.markdown()
    assert report.published[0] in terminal(report, width=400)
    assert [artifact.stage for artifact in report.trained if "published" in artifact.stage] == [
        "world_model, published"
    ]


def test_what_published_results_make_needless_is_no_gap(asked: Asked, layout: Layout) -> None:
    needless = (
        "2 trained parts were not computed, since published results were used in place of what "
        "reads them: critics."
    )
    assert "parts are missing" in report_run(with_parts(asked)).markdown()
    import_artifact(layout, "evaluate", asked.cells[0].key)
    report = report_run(with_parts(asked))
    assert needless in report.published
    assert "parts]" not in report.markdown()
    assert "parts are missing" not in report.markdown()
    # needless too, but of seed 1 it is there: the mean is that of one seed
    layout.manifest("expert", key("expert", 0)).unlink()
    assert "1 of 6 parts are missing: goal1 s0 expert" in report_run(with_parts(asked)).markdown()
    # What is asked for is not there, so there is a gap.
    layout.manifest("diagnostics", key("diagnostics", 0)).unlink()
    report = report_run(with_parts(asked))
    assert needless not in report.published
    assert "4 of 8 parts are missing" in report.markdown()
