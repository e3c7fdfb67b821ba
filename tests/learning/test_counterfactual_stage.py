"""The stage from a cell to its table of branches."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.cells import SETTINGS, Evaluated, evaluated
from wasp_cli.errors import TrainingError
from wasp_cli.learning.configs import CounterfactualConfig
from wasp_cli.learning.counterfactual import least_gain
from wasp_cli.learning.heldout import load_heldout
from wasp_cli.stages.base import Job
from wasp_cli.stages.counterfactual import CounterfactualStage
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.tables import read_steps

SMALL = CounterfactualConfig(window=5, stride=4)


def judge(cell: Evaluated, folder: Path, config: CounterfactualConfig = SMALL, method: str = "ida", **inputs: Path) -> Mapping[str, Any]:
    folder.mkdir(exist_ok=True)
    axes = {"method": method, "method_config": {}, "operator": cell.variant, "value": cell.value}
    read = {**cell.inputs, "evaluate": cell.path.parent, **inputs}
    return CounterfactualStage().run(Job("counterfactual", cell.task, cell.seed, config, SETTINGS, axes, read, folder, folder))


def test_the_rows_say_what_each_branch_was_and_the_summary_is_eq_19_to_21_of_them(cell, tmp_path):
    summary = judge(cell, tmp_path)
    rows = pq.read_table(tmp_path / BRANCHES_FILE).to_pylist()
    assert [path.name for path in tmp_path.iterdir()] == [BRANCHES_FILE]

    steps = read_steps(cell.path).to_pylist()
    interventions = [step for step in steps if step["deviation"] > 0]
    assert summary["interventions"] == len(interventions)
    expected = [(step["episode"], step["t"], step["deviation"], step["gate"]) for step in interventions[::4]]
    for name in ("asst", "cf"):
        mine = [row for row in rows if row["branch"] == name]
        assert [(row["episode"], row["t"], row["deviation"], row["gate"]) for row in mine] == expected
    assert summary["branched"] == len(expected) == len(rows) // 2 > 5

    tau_R = least_gain(load_heldout(cell.inputs["heldout"]), 5, 0.1)
    unnecessary, rho, delta_c, delta_r = [], [], [], []
    for asst, cf in zip(rows[::2], rows[1::2], strict=True):
        assert {row["tau_R"] for row in (asst, cf)} == {tau_R}
        rho.append(sum(cf["costs"]) / 5)
        delta_c.append(sum(cf["costs"]) - sum(asst["costs"]))
        delta_r.append(sum(asst["rewards"]) - sum(cf["rewards"]))
        unnecessary.append(delta_c[-1] <= 0 and delta_r[-1] <= tau_R)
    shown = {"uir": unnecessary, "rho": rho, "delta_c": delta_c, "delta_r": delta_r}
    assert {name: summary[name] for name in shown} == {name: pytest.approx(np.mean(values), abs=1e-4) for name, values in shown.items()}
    identity = {"task": "race1", "method": "ida", "variant": "full", "operator": "noisy", "value": 0.4, "seed": 0, "window": 5}
    assert all(row.items() >= identity.items() for row in rows)


def test_a_limit_makes_the_stride_grow(cell, tmp_path):
    interventions = judge(cell, tmp_path)["interventions"]
    summary = judge(cell, tmp_path, CounterfactualConfig(window=1, stride=2, most=4))
    stored = read_branches(tmp_path / BRANCHES_FILE)
    assert stored.cell.stride == -(-interventions // 4)
    assert summary["branched"] == len(stored.t) == -(-interventions // stored.cell.stride) <= 4


def test_without_interventions_nothing_is_judged_and_the_rate_is_undefined(inputs, tmp_path):
    cell = evaluated(inputs, tmp_path / "cell", "ida", {"vote": 1.0})
    summary = judge(cell, tmp_path / "out")
    assert (summary["interventions"], summary["branched"], summary["uir"]) == (0, 0, None)
    stored = read_branches(tmp_path / "out" / BRANCHES_FILE)
    assert len(stored.t) == 0
    assert (stored.cell.identity.method, stored.cell.episodes) == ("ida", 3)


def test_an_expert_without_whole_windows_gives_no_threshold(cell, tmp_path):
    with pytest.raises(TrainingError, match="no held-out episode of the expert has 26 decisions"):
        judge(cell, tmp_path, CounterfactualConfig(window=26))
