"""Schedules, and times of what was never measured here: from the shipped figures, the size of a
node, and the speed of this machine.
"""

import random
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from tests.commands import ROOT
from wasp_cli.plan import schedule as times
from wasp_cli.plan.grid import lay_out, together
from wasp_cli.plan.node import Node
from wasp_cli.plan.plan import Plan, plan_against
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.plan.schedule import Schedule, simulated
from wasp_cli.plan.text import show
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout

NUMBER = count()


def node(*needs: Node, kind: str = "expert", sort: str = "") -> Node:
    key = f"{next(NUMBER):08d}"
    return Node(
        kind, "goal1", 0, {}, {}, {}, {each.key: each for each in needs}, (), key, key, sort or key
    )


def equal(*nodes: Node) -> dict[str, float]:
    return {each.key: 1.0 for each in nodes}


def test_what_the_longest_path_begins_with_comes_first():
    short, long = node(), node()
    middle = node(long)
    last = node(middle)
    alone = node()
    lasting = {short.key: 1.0, long.key: 1.0, middle.key: 1.0, last.key: 5.0, alone.key: 6.5}
    schedule = Schedule([short, long, middle, last, alone], lasting)
    assert [schedule.pop() for _ in range(len(schedule))] == [long, alone, short]
    schedule.ended(long)
    assert [schedule.pop()] == [middle]


def test_a_node_waits_for_all_that_it_needs_and_for_nothing_else():
    computed = node()
    a, b = node(computed), node()
    both = node(a, b)
    schedule = Schedule([a, b, both], equal(a, b, both))  # what is computed is not among them
    taken = {schedule.pop(), schedule.pop()}
    assert taken == {a, b}
    schedule.ended(b)
    assert not len(schedule)
    schedule.put(a)  # it runs again
    assert schedule.pop() is a
    schedule.ended(a)
    assert schedule.pop() is both
    schedule.ended(both)
    assert not len(schedule)


def test_a_failure_takes_its_dependents_along_each_once_and_no_other():
    bad, good = node(), node()
    child = node(bad)
    grandchild = node(child, bad, good)
    other = node(good)
    schedule = Schedule(
        [bad, good, child, grandchild, other], equal(bad, good, child, grandchild, other)
    )
    assert schedule.failed(bad) == [child, grandchild]
    schedule.ended(good)
    ready = [schedule.pop() for _ in range(len(schedule))]
    assert grandchild not in ready
    assert other in ready
    assert schedule.failed(good) == [other]


@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 2**31))
def test_a_simulation_keeps_to_the_bounds_of_every_schedule(size, workers, seed):
    chance = random.Random(seed)
    nodes: list[Node] = []
    for _ in range(size):
        nodes.append(node(*chance.sample(nodes, chance.randint(0, min(len(nodes), 2)))))
    lasting = {each.key: chance.choice([0.5, 1.0, 3.0]) for each in nodes}
    ends: dict[str, float] = {}
    for each in nodes:
        ends[each.key] = lasting[each.key] + max(
            (ends[needed.key] for needed in each.needs.values()), default=0.0
        )
    work, longest = sum(lasting.values()), max(ends.values())
    total, most = simulated(nodes, lasting, workers)
    # Graham's bound for lists
    assert max(work / workers, longest) - 1e-9 <= total <= work / workers + longest + 1e-9
    assert most <= workers
    assert simulated(nodes, lasting, None)[0] == pytest.approx(longest)
    assert simulated(nodes, lasting, 1)[0] == pytest.approx(work)


@pytest.fixture(autouse=True)
def same_speed(monkeypatch) -> None:
    monkeypatch.setattr(times, "speed", lambda: times.shipped()["speed"])


def planned(spec: str, tmp_path: Path, *settings: str) -> Plan:
    return plan_against(
        lay_out(load(ROOT / "specs" / spec, settings).spec), Layout(tmp_path / "absent")
    )


@pytest.mark.parametrize("spec", ["selftest.yaml", "quickstart.yaml"])
def test_the_first_specs_have_a_figure_for_every_node_and_the_plan_says_that_it_is_an_estimate(
    spec: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded, layout = load(ROOT / "specs" / spec).spec, Layout(tmp_path / "absent")
    plan = plan_against(lay_out_over(loaded, layout), layout)
    seconds, unknown = plan.estimate(2)
    assert unknown == 0
    assert plan.guessed == {node.sort for node in plan.to_run()}
    show(plan, Console(width=200), 2)
    text = capsys.readouterr().out
    assert (
        f"for {len(plan.to_run())} nodes an estimate, from times of nodes like them or of "
        "another machine" in text
    )
    work = sum(plan.seconds[node.sort] for node in plan.to_run())
    assert max(work / 2, plan.critical_path()[0]) <= seconds < work


def test_what_is_published_says_how_long_its_like_takes(tmp_path, capsys):
    layout = Layout(tmp_path / "absent")
    settings = [
        "tasks=[goal1]",
        "seeds=[1]",
        "methods=[ida]",
        "operators.noisy={moderate: 0.45, extreme: 0.7}",
    ]
    grid = lay_out_over(load(ROOT / "specs/table1.yaml", settings).spec, layout)
    plan = plan_against(grid, layout)
    assert plan.count("published", "evaluate"), "the moderate operators are published"
    assert {node.axes["value"] for node in plan.to_run() if node.kind == "evaluate"} == {0.7}
    seconds, unknown = plan.estimate(1)
    assert (seconds > 1, unknown) == (True, 0)
    show(plan, Console(width=200), 1)
    assert "an estimate, from times of nodes like them" in capsys.readouterr().out


def test_each_value_of_a_sweep_over_presets_has_its_own_figures(tmp_path):
    alone = [
        planned("quickstart.yaml", tmp_path, f"preset={preset}") for preset in ("quick", "cpu")
    ]
    plan = plan_against(together([each.grid for each in alone]), Layout(tmp_path / "absent"))
    assert plan.critical_path()[0] == pytest.approx(alone[1].critical_path()[0])


def test_times_grow_with_sizes_and_shrink_with_speed(tmp_path, monkeypatch):
    def of(kind: str, *settings: str) -> float:
        plan = planned("selftest.yaml", tmp_path, *settings)
        return next(plan.seconds[node.sort] for node in plan.to_run() if node.kind == kind)

    before = {kind: of(kind) for kind in ("evaluate", "world_model", "policies")}
    assert of("evaluate", "episodes=20") == pytest.approx(2 * before["evaluate"])
    assert of("world_model", "world_model.updates=3000") == pytest.approx(2 * before["world_model"])
    monkeypatch.setattr(times, "speed", lambda: 2 * times.shipped()["speed"])
    assert of("policies") == pytest.approx(before["policies"] / 2)
