"""Counterfactual branches as nodes of a run, over fake stages: order, repetition, failure, selection, publishing, cleaning up."""

from pathlib import Path

import pytest

from tests.commands import run_here
from tests.run.harness import run
from wasp_cli.run.runner import Summary

KIND = "counterfactual"


@pytest.fixture
def judged_spec(small_spec) -> Path:
    text = small_spec.read_text(encoding="utf-8").replace("seeds: [0, 1]", "seeds: [0]")
    small_spec.write_text(text + "stages: [diagnostics, counterfactual]\n", encoding="utf-8")
    return small_spec


def branches(results: Path) -> set[str]:
    return {path.name for path in results.glob(f"store/{KIND}/*")}


def words(summary: Summary) -> tuple[set[str], set[str]]:
    return {node.label for node, _ in summary.failed}, {node.label for node, _ in summary.blocked}


def test_every_cell_that_may_intervene_is_branched_after_it_and_never_twice(fakes, judged_spec, tmp_path):
    assert run(judged_spec, tmp_path / "results").complete
    executed = fakes.executions()
    judged = [line for line in executed if f" {KIND} " in line]
    assert len(judged) == 2 * 2  # ida and wasp under two operators
    for line in judged:
        cell = line.replace(KIND, "evaluate")
        assert executed.index(cell) < executed.index(line)
    assert not any(" human " in line or " expert " in line for line in judged)
    assert run(judged_spec, tmp_path / "results").done == 0
    assert len(fakes.executions()) == len(executed)


def test_the_plan_counts_them_and_selectors_find_them(fakes, judged_spec, tmp_path):
    shown = run_here("plan", judged_spec, "--results", tmp_path / "results", columns=200)
    assert "the interventions of 4 of them are judged by counterfactual branches" in shown.output
    assert any(line.split()[:2] == [KIND, "4"] for line in shown.output.splitlines())
    options = ("--select", "stage=counterfactual,method=ida,operator=laggy", "-j", "0", "--results", tmp_path / "results")
    assert "counterfactual ida laggy=0.7" in run_here("run", judged_spec, *options, columns=200).output
    assert len(branches(tmp_path / "results")) == 1
