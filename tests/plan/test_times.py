"""Times of what was never measured here: from the shipped figures, the size of a node, and the speed of this machine."""

from pathlib import Path
from typing import Any

import pytest

from wasp_cli.plan import schedule as times
from wasp_cli.plan.grid import lay_out
from wasp_cli.plan.plan import Plan, plan_against, show
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).resolve().parents[2]
measured = times.speed


@pytest.fixture(autouse=True)
def same_speed(monkeypatch) -> None:
    monkeypatch.setattr(times, "speed", lambda: times.shipped()["speed"])


def planned(spec: str, tmp_path: Path, *settings: str) -> Plan:
    return plan_against(lay_out(load(ROOT / "specs" / spec, settings).spec), Layout(tmp_path / "absent"))


def manifest(kind: str, seconds: float, axes: dict[str, Any] | None = None, **config: int) -> dict[str, Any]:
    return {"kind": kind, "task": "goal1", "axes": axes or {}, "config": config, "provenance": {"seconds": seconds}}


@pytest.mark.parametrize("spec", ["selftest.yaml", "quickstart.yaml"])
def test_the_first_specs_have_a_figure_for_every_node_and_the_plan_says_that_it_is_an_estimate(
    spec: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from rich.console import Console

    loaded, layout = load(ROOT / "specs" / spec).spec, Layout(tmp_path / "absent")
    plan = plan_against(lay_out_over(loaded, layout), layout)
    seconds, unknown = plan.estimate(2)
    assert unknown == 0
    assert plan.guessed == {node.sort for node in plan.to_run()}
    show(plan, Console(width=200), 2)
    text = capsys.readouterr().out
    assert f"for {len(plan.to_run())} nodes an estimate, from times of nodes like them or of another machine" in text
    work = sum(plan.seconds[node.sort] for node in plan.to_run())
    assert max(work / 2, plan.critical_path()[0]) <= seconds < work


def test_what_is_published_says_how_long_its_like_takes(tmp_path, capsys):
    from rich.console import Console

    layout = Layout(tmp_path / "absent")
    grid = lay_out_over(
        load(
            ROOT / "specs/table1.yaml", ["tasks=[goal1]", "seeds=[1]", "methods=[ida]", "operators.noisy={moderate: 0.45, extreme: 0.7}"]
        ).spec,
        layout,
    )
    plan = plan_against(grid, layout)
    assert plan.count("published", "evaluate"), "the moderate operators are published"
    assert {node.axes["value"] for node in plan.to_run() if node.kind == "evaluate"} == {0.7}
    seconds, unknown = plan.estimate(1)
    assert (seconds > 1, unknown) == (True, 0)
    show(plan, Console(width=200), 1)
    assert "an estimate, from times of nodes like them" in capsys.readouterr().out


def seconds_of(plan: Plan, label: str) -> float:
    return next(plan.seconds[node.sort] for node in plan.to_run() if node.kind == "evaluate" and f" {label}" in node.label)


def test_times_grow_with_sizes_and_shrink_with_speed(tmp_path, monkeypatch):
    def of(kind: str, *settings: str) -> float:
        plan = planned("selftest.yaml", tmp_path, *settings)
        return next(plan.seconds[node.sort] for node in plan.to_run() if node.kind == kind)

    before = {kind: of(kind) for kind in ("evaluate", "world_model", "policies")}
    assert of("evaluate", "episodes=20") == pytest.approx(2 * before["evaluate"])
    assert of("world_model", "world_model.updates=3000") == pytest.approx(2 * before["world_model"])
    monkeypatch.setattr(times, "speed", lambda: 2 * times.shipped()["speed"])
    assert of("policies") == pytest.approx(before["policies"] / 2)
