"""`wasp severities` over invented cells: what it prints, what it computes, and how it ends."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from click.testing import Result

from tests.commands import run_here
from tests.report.invented import write_returns
from tests.run.harness import Fakes, fakes
from wasp_cli.plan.grid import lay_out
from wasp_cli.spec.derived import operators_alone
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import commit, staging_folder
from wasp_cli.store.layout import Layout

__all__ = ["fakes"]

SPEC = """\
name: little
preset: smoke
tasks: [goal1, race1]
methods: [ida, human, wasp]
variants: [full, safety-only]
operators:
  laggy: {mild: 0.5, moderate: 0.7}
  noisy: {moderate: 0.4}
seeds: [0, 1]
episodes: 2
"""
Returns = Mapping[float | None, tuple[float, float]]
FALLING: Returns = {None: (9, 11), 0.5: (7, 9), 0.7: (5, 7), 0.4: (4, 6)}
"""Returns of both episodes of every seed, by severity value."""
RISING: Returns = {**FALLING, 0.7: (8, 10)}
LINES = [
    f"{task} {line}"
    for task in ("goal1", "race1")
    for line in (
        "laggy: accepted: falls at every step; moderate keeps 60 % of the expert's return",
        "noisy: accepted: only one severity; trend not tested; moderate keeps 50 % of the expert's return",
    )
]


def invoke(*arguments: str | Path) -> Result:
    done = run_here("severities", *arguments, columns=160)
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exc_info
    assert "Traceback" not in done.output
    return done


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    path = tmp_path / "spec.yaml"
    path.write_text(SPEC, encoding="utf-8")
    return path


def store(spec: Path, results: Path, returns: Returns, without: str = "nothing") -> Path:
    """A results folder with all that `wasp severities SPEC` would compute, but for the nodes whose label holds `without`."""
    layout, grid = Layout(results), lay_out(operators_alone(spec).spec)
    cells = {node.key: cell for cell, node in grid.cells}
    for node in grid.nodes:
        if without not in node.label:
            folder = staging_folder(layout, node.key)
            if node.kind == "evaluate":
                write_returns(folder, cells[node.key], returns[cells[node.key].value])
            (folder / "data.bin").write_bytes(b"")  # what fake stages read of each other
            commit(layout, node.kind, node.key, folder, {})
    return results


def test_accepted_operators_print_a_table_and_end_with_0(spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", FALLING)
    before = sorted((results / "store").rglob("*"))
    done = invoke(spec, "--results", results)
    assert done.exit_code == 0, done.output
    assert "0 computed, " in done.stderr
    assert re.search(r"^ Goal1 +Expert +10\.00 ± 0\.00 +100\.0 ", done.stdout, re.MULTILINE)
    assert re.search(r"^ +Laggy +moderate 0\.7 +6\.00 ± 0\.00 +60\.0 .* -2\.00 +0\.00 *$", done.stdout, re.MULTILINE)
    assert re.findall(r"^(?:goal1|race1) .*", done.stdout, re.MULTILINE) == LINES
    page = results / "reports" / "operators-little" / "severity_check.md"
    assert f"table: {page}, " in done.stdout
    assert LINES[3] in page.read_text(encoding="utf-8")
    assert sorted((results / "store").rglob("*")) == before


def test_an_operator_that_is_not_accepted_ends_with_1(spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", RISING)
    done = invoke(spec, "--results", results, "--task", "race1")
    assert done.exit_code == 1
    reason = "rises from 8.0 (mild 0.5) to 9.0 (moderate 0.7), 1.0 +- 0.0; moderate keeps 90 % of the expert's return"
    assert f"race1 laggy: not accepted: {reason}, 1.5 +- " in done.stdout
    assert done.stderr.endswith(
        "error: 1 of 2 operators is not accepted: race1 laggy\n       change its severities in the spec, and say so there\n"
    )
    assert "goal1" not in done.output.lower()


def test_json_is_json_alone_also_when_it_ends_with_1(spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", RISING)
    done = invoke(spec, "--results", results, "--json")
    assert done.exit_code == 1
    record = json.loads(done.stdout)
    assert (record["spec"], [task["task"] for task in record["tasks"]]) == ("operators-little", ["goal1", "race1"])
    outcomes = [(found["operator"], found["outcome"]) for task in record["tasks"] for found in task["operators"]]
    assert outcomes == [("laggy", "not accepted"), ("noisy", "accepted")] * 2
    assert [found["return"] for found in record["tasks"][0]["operators"][0]["severities"]] == [8.0, 9.0]


def test_a_failed_cell_leaves_its_operator_incomplete_and_ends_with_1(fakes: Fakes, spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", RISING, without="goal1 s1 human laggy=0.7")
    fakes.set(behave={"human": "refuse"})
    done = invoke(spec, "--results", results, "-j", "0", "--task", "goal1")
    assert done.exit_code == 1
    assert len(fakes.executions()) == 1
    assert "goal1 laggy: incomplete: 1 of its cells, or of the expert's, is missing" in done.stdout
    assert LINES[1] in done.stdout
    assert "moderate 0.7 [1 of 2 cells]" in done.stdout
    assert "goal1 s1 human laggy=0.7: the loss is not finite" in done.stderr
    assert "run the same command again to retry what failed" in done.stderr


def test_a_cell_without_rows_ends_with_1(fakes: Fakes, spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", FALLING, without="goal1 s0 expert unimpaired")
    done = invoke(spec, "--results", results, "-j", "0")  # the fake stage ends well, and writes no cell
    assert done.exit_code == 1
    assert "error: 1 cell cannot be read:\n  goal1 expert unimpaired seed 0: not computed yet" in done.stderr
    assert done.stdout.count("incomplete: 1 of its cells, or of the expert's, is missing") == 2
    assert LINES[2] in done.stdout


def test_its_run_is_reported_only_where_it_is_named_or_alone(spec: Path, tmp_path: Path) -> None:
    results = store(spec, tmp_path / "results", FALLING)
    invoke(spec, "--results", results, "-j", "0")

    def reported(*more: str) -> set[str]:
        done = run_here("report", results, "--no-films", "--no-trained", *more, columns=200)
        return set(re.findall(r"reports/([\w-]+)/report.html", done.output))

    assert reported() == {"operators-little"}, "nothing else ran"
    run_here("run", spec, "--results", results, "-j", "0", "--set", "methods=[human]", "--set", "variants=[full]", columns=200)
    invoke(spec, "--results", results, "-j", "0")
    assert reported() == {"little"}
    assert reported("--spec", "operators-little") == {"operators-little"}


def test_the_cells_are_those_of_the_whole_spec(spec: Path) -> None:
    with_expert = load(spec, ["methods=[human, wasp, expert]"])
    whole = {str(cell): node.key for cell, node in lay_out(with_expert.spec).cells if cell.method != "wasp"}
    alone = lay_out(operators_alone(spec).spec)
    assert {str(cell): node.key for cell, node in alone.cells} == whole
    assert {node.kind for node in alone.nodes} == {"expert", "dataset", "world_model", "latents", "policies", "evaluate"}


def test_settings_do_not_bring_back_what_is_left_out(spec: Path) -> None:
    settings = ["methods=[ida]", "stages=[critics]", "seeds=[7]", "name=other", "variants=[full]"]
    found = operators_alone(spec, settings).spec
    assert (found.name, found.methods, found.stages, found.seeds) == ("operators-other", ("human", "expert"), (), (7,))


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--set", "seeds"], 2, "is not of the form key=value"),
        (["--task", "goal2"], 2, "unknown task of this spec 'goal2'"),
        (["-j", "-1"], 2, "Invalid value for '--jobs'"),
        (["--set", "operators={lagy: {mild: 0.5}}"], 3, "did you mean 'laggy'?"),
        (["--set", "operators={}", "--set", "methods=[expert]", "--set", "variants=[full]"], 3, "no operators are listed"),
        (["--set", "operators={}"], 3, "name at least one variant"),
    ],
)
def test_wrong_input_ends_with_2_or_3(spec: Path, tmp_path: Path, arguments: list[str], code: int, message: str) -> None:
    done = invoke(spec, "--results", tmp_path / "none", *arguments)
    assert (done.exit_code, message in " ".join(done.stderr.split()), done.stdout) == (code, True, ""), done.output
    assert not (tmp_path / "none").exists()


def test_a_spec_that_only_trains_has_no_operators(tmp_path: Path) -> None:
    path = tmp_path / "models.yaml"
    path.write_text("name: models\ntasks: [goal1]\nmethods: []\nseeds: [0]\n", encoding="utf-8")
    done = invoke(path, "--results", tmp_path / "none")
    assert (done.exit_code, f"{path}:1:1: no operators are listed" in done.stderr) == (3, True), done.output
