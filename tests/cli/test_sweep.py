"""`wasp sweep` from end to end, over fake stages whose evaluations leave cells that can be
worked out by hand.
"""

import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from tests.commands import run_here
from tests.compare.two_runs import episodes, write_results
from tests.report.invented import write_rows
from tests.report.swept import two_episodes
from tests.run.harness import Fakes, fakes, small_spec
from tests.store.test_untrusted import snapshot
from wasp_cli.plan.grid import stage_class
from wasp_cli.report.render import RENDERERS
from wasp_cli.stages.base import Job
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import CellIdentity

__all__ = ["fakes", "small_spec"]

VARY = ("--vary", "diffusion.ratio=0.2,0.4")


@pytest.fixture
def cells(fakes: Fakes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fake evaluations write a cell: Diffusion reaches ten goals more for each unit of its
    ratio, at no cost; Human-only costs 50.
    """
    stage: Any = stage_class("evaluate")
    before = stage.run

    def run(self: Any, job: Job) -> Mapping[str, Any]:
        summary: Mapping[str, Any] = before(self, job)
        axes = job.axes
        identity = CellIdentity(
            job.task, axes["method"], "full", axes["operator"], axes["value"], job.seed
        )
        ratio = axes["method_config"].get("ratio", 0.0)
        write_rows(
            job.out_dir,
            identity,
            two_episodes(identity, round(2 + 10 * ratio), ratio, 0.0 if ratio else 1.0),
            success_goals=3,
        )
        return summary

    monkeypatch.setattr(stage, "run", run)


def sweep(spec: Path, results: Path, *arguments: str, code: int | None = None) -> Result:
    return run_here(
        "sweep", spec, *arguments, "--results", results, "-j", "0", columns=160, code=code
    )


def test_the_table_and_the_page(cells: None, small_spec: Path, tmp_path: Path) -> None:
    done = sweep(small_spec, tmp_path / "results", *VARY, code=0)
    rows = [line.split() for line in done.stdout.splitlines()]
    # goals + 3 (tests/report/swept.py): the operator alone reaches 2, with a ratio of 0.2 and 0.4
    # it is 4 and 6.
    assert [row[:4] for row in rows if row[:2] == ["Goal1", "Human-only"]] == [
        ["Goal1", "Human-only", "-", "5.00"]
    ]
    values = [row for row in rows if row[:1] == ["Diffusion"]]
    assert [row[1] for row in values] == ["0.2", "0.4"]
    assert [row[2:4] for row in values[:2]] == [["7.00", "(+2.00)"], ["9.00", "(+4.00)"]]
    assert "computed" not in done.stdout
    assert "nodes are the same for all of them" in done.stderr
    folder = Layout(tmp_path / "results").reports("small-sweep-diffusion.ratio")
    assert f"report: {folder.absolute()}/report.md" in done.stdout
    assert {path.name for path in folder.iterdir()} == {
        "report.md",
        *(f"sweep.{ending}" for ending in ("md", "csv", "tex", "html")),
    }
    key = next((tmp_path / "results/store/evaluate").iterdir()).name
    run_here(
        "note",
        key,
        "a <b>hazard",
        "-e",
        "1",
        "--invalid",
        "--results",
        tmp_path / "results",
        columns=200,
        code=0,
    )
    shown, page = (
        sweep(small_spec, tmp_path / "results", *VARY).stdout,
        (folder / "report.md").read_text(encoding="utf-8"),
    )
    assert (
        "1 episode marked as invalid is not counted in any number here." in shown,
        "a &lt;b>hazard" in page,
    ) == (True, True)


def test_a_dry_run_shows_the_plan_of_all_values_and_writes_nothing(
    small_spec: Path, tmp_path: Path
) -> None:
    assert (
        "12 cells to evaluate"
        in sweep(small_spec, tmp_path / "results", *VARY, "--dry-run", code=0).stdout
    )
    record = json.loads(
        sweep(small_spec, tmp_path / "results", *VARY, "--dry-run", "--json").stdout
    )
    assert record["spec"] == "small-sweep-diffusion.ratio"
    assert sum(node["kind"] == "evaluate" for node in record["nodes"]) == 12
    assert not (tmp_path / "results").exists()


def test_json_is_json_alone(cells: None, small_spec: Path, tmp_path: Path) -> None:
    done = sweep(small_spec, tmp_path / "results", *VARY, "--json", "--task", "goal1")
    record = json.loads(done.stdout)
    assert (record["name"], record["spec"], record["setting"]) == (
        "small-sweep-diffusion.ratio",
        "small",
        "diffusion.ratio",
    )
    assert [
        (row["method"], row["value"], row["return"]["mean"], row["cost"]["difference"])
        for row in record["rows"]
    ] == [
        ("human", None, 5.0, None),
        ("diffusion", 0.2, 7.0, -50.0),
        ("diffusion", 0.4, 9.0, -50.0),
    ]
    assert Path(record["report"]).is_file()


def test_a_value_that_fails_leaves_the_rows_of_the_others(
    cells: None, fakes: Fakes, small_spec: Path, tmp_path: Path
) -> None:
    fakes.set(behave={"s1 evaluate diffusion {'ratio': 0.4, 'last_noise': False} noisy": "refuse"})
    done = sweep(small_spec, tmp_path / "results", *VARY, code=1)
    assert (
        "error: 1 failed:\n  goal1 s1 diffusion noisy=0.2 [diffusion.ratio=0.4]: the loss "
        "is not finite" in done.stderr
    )
    rows = [line.split() for line in done.stdout.splitlines()]
    assert ["Diffusion", "0.2", "7.00"] in [row[:3] for row in rows]
    assert ["Diffusion", "[3", "of", "4", "cells]", "0.4"] in [row[:6] for row in rows]
    assert (
        "goal1 diffusion noisy=0.2 seed 1 [diffusion.ratio=0.4]: failed: the loss is not finite"
        in done.stdout
    )
    page = Layout(tmp_path / "results").reports("small-sweep-diffusion.ratio") / "report.md"
    assert r"- goal1 diffusion noisy=0.2 seed 1 \[diffusion.ratio=0.4\]: failed" in page.read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (
            ["--vary", "diffusion.ratio=0.2,2,-1"],
            3,
            "--vary diffusion.ratio=2: diffusion.ratio: should be less than or equal to 1, not 2",
        ),
        (["--vary", "diffusion.ratios=0.2,0.4"], 3, "did you mean 'ratio'?"),
        (["--vary", "seeds=[0],[1]"], 2, "list them in the spec: a row is the mean over all seeds"),
        (["--vary", "diffusion.ratio=0.2,0.4", "--method", "idaa"], 2, "did you mean 'ida'?"),
        (
            ["--vary", "diffusion.ratio=0.2,0.4", "--task", "race1"],
            2,
            "unknown task of this spec 'race1'",
        ),
        (
            ["--vary", "diffusion.ratio=0.2,0.4", "--vary", "ida.vote=0,1"],
            2,
            "a sweep varies one setting",
        ),
        ([], 2, "Missing option '--vary'"),
    ],
)
def test_wrong_input_is_one_message_and_nothing_is_written(
    arguments: list[str], code: int, message: str, small_spec: Path, tmp_path: Path
) -> None:
    done = sweep(small_spec, tmp_path / "results", *arguments, code=code)
    assert message in " ".join(done.stderr.replace("│", " ").split())
    assert done.stdout == ""
    assert not (tmp_path / "results").exists()


def test_the_page_says_what_was_published(cells: None, small_spec: Path, tmp_path: Path) -> None:
    elsewhere, here = tmp_path / "elsewhere", tmp_path / "results"
    only = ("--set", "methods=[human]")
    assert (
        run_here("run", small_spec, *only, "--results", elsewhere, "-j", "0", columns=160).exit_code
        == 0
    )
    done = run_here(
        "publish",
        small_spec,
        *only,
        "--results",
        elsewhere,
        "--to",
        here / "published",
        columns=160,
        code=0,
    )
    done = sweep(small_spec, here, *VARY, "--set", "reuse=published", code=0)
    page = (Layout(here).reports("small-sweep-diffusion.ratio") / "report.md").read_text()
    for text in (page, done.stdout):
        for value in ("0.2", "0.4"):
            assert f"diffusion.ratio = {value}: " in text
        assert " results here are published ones (" in text
    assert "Published cells: goal1 s0 human noisy=0.2, goal1 s1 human noisy=0.2, " in page


# `wasp compare` from outside.


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds `one`, its copy `two`, `other` under another spec's name and with more cost, and
    `empty`.
    """
    path = tmp_path_factory.mktemp("folders")
    write_results(path / "one", lambda identity: episodes(identity, count=10))
    shutil.copytree(path / "one", path / "two")
    write_results(
        path / "other", lambda identity: episodes(identity, count=10, risk=0.9), name="mine"
    )
    (path / "empty").mkdir()
    return path


def test_a_copy_is_alike(folder: Path) -> None:
    before = snapshot(folder)
    done = run_here("compare", folder / "one", folder / "two", "--strict", columns=120)
    assert (done.exit_code, done.stderr) == (0, "")
    assert "8 cells: 8 the same; none differ by more than noise." in done.stdout
    assert snapshot(folder) == before


def test_two_named_specs_are_compared_and_strict_tells_by_its_exit_code(folder: Path) -> None:
    arguments = (
        "compare",
        folder / "one",
        folder / "other",
        "--spec-a",
        "tiny",
        "--spec-b",
        "mine",
    )
    done = run_here(*arguments, columns=120, code=0)
    assert "8 cells: 8 other rows; 8 differ by more than noise." in done.stdout
    assert "Cells that differ" in done.stdout
    assert "Difference of each assistant" in done.stdout
    strict = run_here(*arguments, "--strict", columns=120)
    assert (strict.exit_code, strict.stdout) == (1, done.stdout)
    assert "not alike: tiny" in strict.stderr


def test_json_is_all_of_stdout(folder: Path) -> None:
    done = run_here("compare", folder / "one", folder / "two", "--json", columns=120)
    (facts,) = json.loads(done.stdout)
    assert (facts["alike"], len(facts["cells"]), facts["first"]["spec"]) == (True, 8, "tiny")


def test_out_writes_every_table_in_every_format(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    done = run_here(
        "compare",
        folder / "one",
        folder / "other",
        "--spec-a",
        "tiny",
        "--spec-b",
        "mine",
        "--out",
        out,
        columns=120,
        code=0,
    )
    assert str(out / "compare.md") in done.stdout
    tables = {f"tiny-{name}.{ending}" for name in ("cells", "summary") for ending in RENDERERS}
    assert {path.name for path in out.iterdir()} == {"compare.md", *tables}


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("one", "absent"), "no such folder"),
        (("empty", "one"), "it holds no runs"),
        (("one", "other"), "no spec has run in both folders"),
        (("one", "two", "--spec", "tinny"), "did you mean 'tiny'?"),
        (("one", "other", "--spec-a", "tiny"), "need each other"),
        (("one", "other", "--spec-a", "tiny", "--spec-b", "mein"), "did you mean 'mine'?"),
        (("one", "other", "--spec", "tiny", "--spec-b", "mine"), "need each other"),
        (("one", ""), "the name of the folder is empty"),
        (("one", os.fsdecode(b"caf\xe9")), "bytes that are not UTF-8"),
        (("one", "two", "--out", __file__), "is not a folder"),
    ],
)
def test_what_cannot_be_compared_ends_with_2(
    folder: Path, arguments: tuple[str, ...], what: str
) -> None:
    named = [
        str(folder / each) if each in ("one", "two", "other", "empty", "absent") else each
        for each in arguments
    ]
    assert what in " ".join(run_here("compare", *named, columns=200, code=2).stderr.split())


def test_a_damaged_plan_ends_with_2(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "one", tmp_path / "damaged")
    (plan,) = (tmp_path / "damaged" / "runs").glob("*/plan.json")
    plan.write_text('{"spec": "tiny", "cells": 7}')
    assert (
        "cannot read the plan of run"
        in run_here("compare", folder / "one", tmp_path / "damaged", columns=200, code=2).stderr
    )
