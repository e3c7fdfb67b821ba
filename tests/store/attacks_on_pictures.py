"""What an untrusted results folder may hold against who draws it: films, maps, the page of a report, episodes played again."""

import math
from pathlib import Path

from tests.run.recorded import key
from tests.store.attacks import attack, link
from tests.store.untrusted import UntrustedStore
from wasp_cli.store.artifact import write_record

SCRIPT = "<script>alert(1)</script>"


@attack
def worlds_that_are_no_numbers(it: UntrustedStore, outside: Path) -> None:
    """Seeds so large that two of them are one floating-point number."""
    it.played(4)
    it.rows(episode_seed=[2**62 + 1])


@attack
def a_decision_without_end(it: UntrustedStore, outside: Path) -> None:
    it.played(10**12)


@attack
def episodes_of_another_world(it: UntrustedStore, outside: Path) -> None:
    it.played(4)


@attack
def actions_of_no_robot(it: UntrustedStore, outside: Path) -> None:
    it.played(4)
    it.steps(a=[], a_h=[])


@attack
def commands_that_no_map_can_show(it: UntrustedStore, outside: Path) -> None:
    it.played(4)
    it.steps(a=[math.nan, math.inf], a_h=[3e38, -3e38])


@attack
def cells_that_are_markup(it: UntrustedStore, outside: Path) -> None:
    """The page of a report runs its own script and no other."""
    it.plan(cells=[{**it.cell, "severity": SCRIPT, "operator": SCRIPT}])
    it.manifest(label=SCRIPT, summary={SCRIPT: 1})
    it.fails(message=SCRIPT, label=SCRIPT)


@attack
def upstream_of_a_replay_elsewhere(it: UntrustedStore, outside: Path) -> None:
    kinds = ("world_model", "policies", "calibration")
    it.played(4)
    it.manifest(upstream_kinds={kind: kind for kind in kinds}, upstream=dict.fromkeys(kinds, "../../../outside"))
    it.layout.kind("counterfactual").mkdir(exist_ok=True)
    link(it.layout.artifact("counterfactual", key(3)), outside)
    write_record(it.layout.manifest("counterfactual", key(4)), {"kind": "counterfactual", "upstream": [it.key], "config": 7})
