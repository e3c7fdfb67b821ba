"""A preset that is named over a spec brings its sizes, whatever the spec has of its own."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.commands import ROOT, run_here
from tests.run.harness import SMALL, fakes
from tests.run.layered import fresh_console
from wasp_cli.drive.prepare import shipped
from wasp_cli.plan.grid import lay_out
from wasp_cli.run.session import RunOptions, run_spec
from wasp_cli.spec.load import Loaded, ablation, load, read_sweep, sized
from wasp_cli.spec.model import Spec
from wasp_cli.spec.presets import PRESETS, preset_values

__all__ = ["fakes", "fresh_console"]

SPECS = ROOT / "specs"
FULL = ["field", "table1", "table2", "paper-size", "operators", "goal1-two", "study", "drive"]
"""Shipped specs of the preset `cpu` that have sizes of their own, or extend one that has."""


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def value(spec: Spec, task: str, *place: str) -> Any:
    """What a spec has for a task under the names of a setting."""
    found: Any = spec.stage(place[0], task).model_dump(mode="json")
    for name in place[1:]:
        found = found[name]
    return found


def leaves(values: Mapping[str, Any], *above: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, below in values.items():
        if isinstance(below, Mapping):
            yield from leaves(below, *above, name)
        else:
            yield (*above, name), below


def nodes(loaded: Loaded) -> list[str]:
    return [node.key for node in lay_out(loaded.spec).nodes]


@pytest.mark.parametrize("name", FULL)
@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "cpu"])
def test_a_preset_of_the_command_line_has_all_its_sizes_for_every_task(name, preset):
    spec = load(SPECS / f"{name}.yaml", sized(preset)).spec
    for place, wanted in leaves(preset_values(preset)):
        if place == ("episodes",):
            assert spec.episodes == spec.stage("evaluate").episodes == wanted
        else:
            assert {str(value(spec, task, *place)) for task in spec.tasks} == {str(wanted)}, place


def test_a_size_that_the_preset_leaves_at_its_default_is_the_default(tmp_path):
    own = "expert: {hidden: [16], batch: 32}\nworld_model: {updates: 3}\n"
    spec = load(written(tmp_path, "own", SMALL + own), sized("cpu")).spec
    bare = load(written(tmp_path, "bare", SMALL.replace("smoke", "cpu"))).spec
    for name in ("expert", "world_model"):
        assert spec.stage(name) == bare.stage(name)
    assert spec.episodes == bare.episodes == 30


@pytest.mark.parametrize("preset", ["quick", "gpu", "paper"])
def test_what_is_no_size_stays_as_the_spec_has_it(preset):
    spec = load(SPECS / "table1.yaml", sized(preset)).spec
    assert (spec.seeds, spec.side_by_side, spec.stage("wasp").tau_c) == ((1, 2, 3, 4, 5), 10, 0.5)
    assert spec.stage("diffusion").ratio == 0.6
    assert spec.stage("ida").quantile == 0.5, "an operating point, which smoke alone sets"
    assert spec.stage("policies").return_share == 0.95
    assert spec.stage("world_model", "formula1").privileged == 25
    assert spec.stage("expert", "formula1").late_cost_limit == 1


def test_a_small_training_is_not_asked_for_what_a_full_one_reaches():
    bars = {
        preset: load(SPECS / "field.yaml", sized(preset)).spec.stage("expert").bars
        for preset in ("smoke", "quick", "paper", "cpu")
    }
    assert not bars["smoke"]
    assert not bars["quick"]
    assert bars["paper"] == bars["cpu"] == load(SPECS / "field.yaml").spec.stage("expert").bars


def test_the_preset_that_a_spec_has_leaves_its_sizes_alone():
    for name in FULL:
        path = SPECS / f"{name}.yaml"
        asked = load(path, sized("cpu"))
        assert asked.spec == load(path).spec
        assert not asked.replaced


def test_an_option_that_sets_a_size_wins_over_the_preset_in_any_order():
    settings = ["expert.interactions=70", "preset=smoke", "episodes=4"]
    for order in (settings, settings[::-1]):
        spec = load(SPECS / "field.yaml", order).spec
        assert {value(spec, task, "expert", "interactions") for task in spec.tasks} == {70}
        assert spec.episodes == 4
    whole = load(SPECS / "field.yaml", ["expert={interactions: 70, bars: {}}", "preset=smoke"]).spec
    assert value(whole, "goal1", "expert", "interactions") == 70


def test_preset_as_an_option_and_as_a_setting_are_the_same():
    path = SPECS / "table1.yaml"
    both = [load(path, sized("smoke")), load(path, ["preset=smoke"])]
    assert both[0].spec == both[1].spec
    assert nodes(both[0]) == nodes(both[1])


def test_a_file_over_another_one_brings_the_sizes_of_its_preset_and_keeps_its_own(tmp_path):
    text = "extends: field\nname: mine\npreset: quick\nworld_model: {updates: 9}\nepisodes: 3\n"
    spec = load(written(tmp_path, "mine", text)).spec
    assert value(spec, "goal1", "expert", "interactions") == 320_000
    assert value(spec, "formula1", "policies", "hidden") == [128, 128]
    assert (spec.stage("world_model").updates, spec.episodes) == (9, 3)
    over = written(tmp_path, "over", "extends: mine.yaml\nname: over\npreset: smoke\n")
    assert load(over).spec.stage("world_model").updates == 20


def test_an_ablation_a_sweep_and_a_drive_have_the_sizes_too():
    settings = ["seeds=[0]"]
    ablated = ablation(SPECS / "table2.yaml", "no-case2", ["goal1"], "smoke", settings)
    swept = read_sweep(SPECS / "table1.yaml", "wasp.tau_c=0.3,0.5", settings=sized("smoke"))
    driven = shipped("goal1", ["wasp"], 0, [0], "smoke")
    for loaded in (ablated, *(point.loaded for point in swept.points), driven):
        assert value(loaded.spec, "goal1", "expert", "interactions") == 2000
    assert driven.spec.episodes == 5, "how long a person sits there is no size"


def test_a_plan_says_what_the_preset_replaced_for_the_tasks_that_it_has(tmp_path):
    def notes(*options: str) -> list[str]:
        asked = ("plan", SPECS / "table1.yaml", "--reuse", "none", "--results", tmp_path, *options)
        shown = run_here(*asked, columns=None, code=0).stdout
        return [line for line in shown.splitlines() if line.startswith("preset ")]

    (line,) = notes("--preset", "smoke", "--task", "goal1")
    assert "smoke" in line
    assert "episodes 30 -> 2" in line
    assert "goal1: expert.interactions 800000 -> 2000" in line
    assert "formula1" not in line
    assert (
        notes("--preset", "smoke", "--task", "goal1", "--set", "expert.interactions=5")[0] != line
    )
    assert not notes()
    assert not notes("--preset", "cpu")


def test_a_run_says_what_the_preset_replaced(tmp_path, fakes, fresh_console, capfd):
    spec = written(tmp_path, "own", SMALL + "expert: {interactions: 7}\n")
    run_spec(load(spec, sized("quick", ["methods=[human]"])), tmp_path, RunOptions(jobs=0))
    assert "expert.interactions 7 -> 320000" in capfd.readouterr().err
