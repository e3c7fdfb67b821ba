"""Parts that were published in half precision give other numbers under the same keys: everything that shows them says so."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.commands import run_here
from tests.compare.two_runs import episodes, write_results
from tests.plan.test_plan import text_of
from tests.run.layered import fresh_console, plan, run
from wasp_cli.compare import Causes
from wasp_cli.run.publish import carry_publication, publication
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.layout import Layout
from wasp_cli.store.slim import Slimming

__all__ = ["fresh_console"]

PARTS = ("stage!=evaluate|calibration",)


@pytest.fixture
def whole(fakes, small_spec, tmp_path) -> Layout:
    """Results whose parts have weights."""
    fakes.set(weights=True)
    layout = Layout(tmp_path / "whole")
    run_spec(load(small_spec), layout.root, RunOptions(jobs=0)).require_complete()
    return layout


def published(spec: Path, whole: Layout, results: Path, *, half: bool, selectors: tuple[str, ...] = PARTS) -> Path:
    target = Layout(results / "published")
    found = publication(load(spec).spec, whole, target, selectors, 8e6, "none")
    carry_publication(found, load(spec).spec, whole, target, Slimming(half=half))
    return results


def cells(layout: Layout) -> list[dict[str, Any]]:
    return [json.loads(path.read_text(encoding="utf-8")) for path in layout.store.glob("evaluate/*/_manifest.json")]


def test_a_plan_and_the_manifests_say_it(whole, small_spec, tmp_path):
    results = published(small_spec, whole, tmp_path / "results", half=True)
    before = plan(small_spec, results)
    reasons = {step.reason for step in before.steps if step.state == "published"}
    assert "published with this code, in half precision" in reasons
    computed = [step for step in before.steps if step.runs]
    assert computed
    assert f"{len(computed)} nodes are computed from parts in half precision" in text_of(before)
    run(small_spec, results)
    after = Layout(results)
    made = [manifest for manifest in cells(after) if "half_precision" in manifest["provenance"]]
    assert {"wasp", "ida"} <= {manifest["axes"]["method"] for manifest in made}
    for manifest in made:
        assert set(manifest["provenance"]["half_precision"]) <= set(manifest["upstream"])
        # The key is that of full precision, so a comparison has to say why the rows differ.
        assert read_manifest(whole, "evaluate", manifest["key"])["key"] == manifest["key"]
        causes = Causes(whole, after).of("evaluate", manifest["key"], manifest["key"])
        assert any(cause.startswith("inputs in half precision none -> ") for cause in causes)
    again = {step.node.key: step.reason for step in plan(small_spec, results, choice="none").steps}
    assert {again[manifest["key"]] for manifest in made} == {"computed before, computed from parts in half precision"}
    # What is published in turn does not lose it.
    onward = published(small_spec, after, tmp_path / "onward", half=False, selectors=("stage=evaluate",))
    assert sum("half_precision" in manifest["provenance"] for manifest in cells(Layout(onward / "published"))) == len(made)


def test_the_report_and_the_comparison_say_it(without_figures, tmp_path):
    write_results(tmp_path / "whole")
    write_results(tmp_path / "half", lambda identity: episodes(identity, risk=0.3), {"half_precision": ["policies", "world_model"]})
    told = run_here("report", tmp_path / "half", "--no-films", "--no-trained", "--paper", "none", columns=200)
    assert "8 cells were computed from parts in half precision" in told.output
    assert "half precision" in (tmp_path / "half/reports/tiny/report.html").read_text(encoding="utf-8")
    compared = run_here("compare", tmp_path / "whole", tmp_path / "half", columns=200)
    assert "inputs in half precision none -> policies, world_model" in compared.output
