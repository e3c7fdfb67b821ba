from __future__ import annotations

from typing import Any

from wasp_cli.plan.node import Part
from wasp_cli.report.render import csv_text, markdown
from wasp_cli.report.tables.table import Table
from wasp_cli.report.trained.artifacts import Trained
from wasp_cli.report.trained.tables import training_tables

SUMMARIES: dict[str, dict[str, Any]] = {
    "expert": {"return": 20.0, "cost": 30.0, "success": 0.9, "multiplier": 0.4},
    "dataset": {"steps": 1000, "costly_share": 0.05},
    "world_model": {"skipped": 0},
    "diagnostics": {"auprc@1": 0.8, "auprc@5": None, "reward_r2@5": 0.3},
    "policies": {"return": 18.0, "cost": 33.0, "privileged_return": 20.0, "privileged_cost": 30.0},
    "critics": {"rank_r": 0.7, "rank_c": None},
}
Parts = list[tuple[Part, str]]


def chain(seeds: tuple[int, ...] = (0,), task: str = "goal1") -> tuple[Parts, list[Trained]]:
    """Every part of a chain with its artifact; a later seed has other numbers."""
    parts, trained = [], []
    for seed in seeds:
        for kind in ("expert", "dataset", "world_model", "policies", "critics", "diagnostics"):
            part, key = Part(task, kind, seed), f"{kind}{seed}"
            told = {name: value + seed if isinstance(value, float) else value for name, value in SUMMARIES[kind].items()}
            parts.append((part, key))
            trained.append(Trained(kind, task, seed, key, 1.0, told))
    return parts, trained


def numbers(table: Table, row: int = 0) -> dict[str, float | None]:
    return {column.key: value.mean for column, value in zip(table.columns, table.rows[row].values, strict=True)}


def test_a_chain_is_one_row_of_what_its_stages_tell() -> None:
    stages, ahead = training_tables(*chain())
    assert [row.labels for row in stages.rows] == [("Goal1",)]
    assert numbers(stages) == {
        "expert.return": 20.0, "expert.cost": 30.0, "expert.success": 0.9, "dataset.costly_share": 0.05,
        "policies.return": 18.0, "policies.privileged_return": 20.0, "policies.cost": 33.0, "policies.privileged_cost": 30.0,
        "critics.rank_r": 0.7, "critics.rank_c": None,
    }  # fmt: skip
    assert not stages.notes
    assert "| Goal1 | 20.0 | 30.0 | 90 | 5.0 | 18.0 | 20.0 | 33.0 | 30.0 | 0.70 | n/a |" in markdown(stages)
    # Only steps and measures that the stage tells: what it knows to be undefined is shown as such.
    assert [(row.labels[1], [value.mean for value in row.values]) for row in ahead.rows] == [
        ("Cost AUPRC", [0.8, None]), ("Reward R²", [None, 0.3]),
    ]  # fmt: skip
    assert csv_text(ahead).splitlines()[0] == "task,measure,step_1,step_5,seeds"


def test_seeds_are_averaged_and_their_spread_is_shown() -> None:
    stages, _ = training_tables(*chain(seeds=(0, 1)))
    value = stages.rows[0].values[0]
    assert (value.mean, value.n) == (20.5, 2)
    assert value.sd is not None
    assert abs(value.sd - 0.5**0.5) < 1e-12


def test_what_is_missing_is_named_and_never_a_number() -> None:
    parts, trained = chain(seeds=(0, 1))
    there = [one for one in trained if one.stage not in ("critics", "diagnostics") and not (one.stage == "expert" and one.seed == 1)]
    stages, ahead = training_tables(parts, there, {"critics0": "failed: no luck"})
    assert stages.rows[0].labels == ("Goal1 [5 of 8 parts]",)
    found = numbers(stages)
    assert (found["expert.return"], found["critics.rank_r"], found["critics.rank_c"]) == (20.0, None, None)
    assert stages.notes == (
        "INCOMPLETE: 5 of 12 parts are missing: goal1 s0 critics (failed: no luck), goal1 s1 expert, goal1 s1 critics, "
        "goal1 s0 diagnostics, goal1 s1 diagnostics.",
    )
    assert [row.labels for row in ahead.rows] == [("Goal1", "Cost AUPRC [0 of 2 parts]")]
    assert all(value.mean is None for value in ahead.rows[0].values)


def test_nothing_to_tell_is_no_table() -> None:
    assert training_tables([], []) == []
    part = (Part("goal1", "residual", 0), "key")
    assert training_tables([part], [Trained("residual", "goal1", 0, "key", 1.0, {"number": 1})]) == []
