"""Branches of the real task against the episodes they begin in, and the stage from a cell to
its table of branches.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.cells import DECISIONS, SETTINGS, Evaluated, evaluated
from wasp_cli.errors import TrainingError
from wasp_cli.learning.closed_loop import run_episodes
from wasp_cli.learning.configs import CounterfactualConfig
from wasp_cli.learning.counterfactual import Branch, branches, least_gain, sampled
from wasp_cli.learning.heldout import load_heldout
from wasp_cli.learning.rerun import Recorded
from wasp_cli.methods.base import Decision, Heldout
from wasp_cli.methods.human import HumanOnly
from wasp_cli.methods.record import blank_record
from wasp_cli.metrics.episode import GATE_METHOD
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.models.base import Latent
from wasp_cli.models.world_model import load_world_model
from wasp_cli.operators.registry import OPERATORS
from wasp_cli.stages.base import Job, no_progress
from wasp_cli.stages.counterfactual import CounterfactualStage
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.recorded import read_recorded
from wasp_cli.store.tables import read_steps

IDA = {"vote": 0.0}  # on untrained models it intervenes at some decisions, and not at others
VALUES = {"limited-skill": 0.25, "reaction-time": 0.8}
WINDOW = 6


def same(one: Branch, other: Branch) -> bool:
    return one[:3] == other[:3] and all(
        np.array_equal(a, b) for a, b in zip(one[3:], other[3:], strict=True)
    )


class Script(HumanOnly):
    """Executes what was recorded before decision t, then one action, then the commands; in one
    row, the others follow the record.
    """

    def __init__(self, recorded: Recorded, row: int, t: int, assisted: bool) -> None:
        self.recorded, self.row, self.t, self.assisted, self.now = recorded, row, t, assisted, -1

    def decide(self, latent: Latent, a_h: torch.Tensor, operator: Any) -> Decision:
        self.now += 1
        action = torch.from_numpy(
            np.stack([actions[min(self.now, len(actions) - 1)] for actions in self.recorded.a])
        )
        if self.now > self.t or (self.now == self.t and not self.assisted):
            action[self.row] = a_h[self.row]
        return Decision(action, blank_record(len(action), GATE_METHOD))


CELLS = {"noisy": ("ida", IDA, 0.4, "race1"), "reactive": ("diffusion", {}, 0.8, "goal1")}
"""The reactive operator needs corrections that are large enough for its reaction to show in the
rewards.
"""


@pytest.mark.parametrize("variant", CELLS)
def test_both_branches_are_what_whole_episodes_with_and_without_the_intervention_give(
    inputs, tmp_path, variant
):
    method, config, value, task = CELLS[variant]
    cell = evaluated(inputs, tmp_path, method, config, variant, value, task=task)
    recorded = Recorded(**read_recorded(cell.path))
    intervened = [
        np.flatnonzero((a != a_h).any(1)) for a, a_h in zip(recorded.a, recorded.a_h, strict=True)
    ]
    chosen = [[], [], intervened[2][[1]].tolist()]  # how many there are depends on the machine
    found = branches(cell.rerun(), chosen, WINDOW, no_progress)
    assert [(b.episode, b.t, b.name) for b in found] == [
        (e, t, name) for e, steps in enumerate(chosen) for t in steps for name in (ASSISTED, ALONE)
    ]
    for branch in found:
        world = cell.world()
        script = Script(recorded, branch.episode, branch.t, branch.name == ASSISTED)
        model = load_world_model(cell.inputs["world_model"])
        loop = run_episodes(
            world, model, cell.operator(world), script, recorded.layouts, recorded.layouts
        )
        part = slice(branch.t, branch.t + WINDOW)
        for field in ("reward", "cost", "cost_env"):
            np.testing.assert_array_equal(
                getattr(branch, field),
                getattr(loop, field)[part, branch.episode],
                err_msg=f"{branch[:3]}",
            )
    assert any(
        not np.array_equal(one.reward, two.reward)
        for one, two in zip(found[::2], found[1::2], strict=True)
    )


QUICK = ("noisy", "reactive")
"""An operator that draws, and one that remembers and heeds what was executed; of all operators
tests/contract asks for snapshots.
"""


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name, info in OPERATORS.items()
        if info.simulated
    ],
)
def test_without_an_intervention_both_branches_are_the_real_continuation(inputs, tmp_path, variant):
    cell = evaluated(inputs, tmp_path, "human", {}, variant, VALUES.get(variant, 0.5))
    recorded = Recorded(**read_recorded(cell.path))
    chosen = [[0, 4, 8], [3], []]
    found = branches(cell.rerun(), chosen, WINDOW, no_progress)
    assert len(found) == 2 * 4
    for branch in found:
        assert len(branch.reward) == min(WINDOW, DECISIONS - branch.t)
        expected = recorded.reward[branch.episode][branch.t : branch.t + WINDOW]
        np.testing.assert_array_equal(branch.reward.astype(np.float32), expected)
    for assisted, alone in zip(found[::2], found[1::2], strict=True):
        assert same(assisted._replace(name=ALONE), alone)


@given(st.lists(st.lists(st.booleans(), max_size=12), min_size=1, max_size=6), st.integers(1, 9))
def test_the_interventions_of_a_cell_are_sampled_evenly(intervened, stride):
    chosen = sampled([np.array(steps, bool) for steps in intervened], stride)
    everything = [
        (e, t) for e, steps in enumerate(intervened) for t, deviates in enumerate(steps) if deviates
    ]
    assert [(e, t) for e, decisions in enumerate(chosen) for t in decisions] == everything[::stride]


def test_the_least_gain_is_a_share_of_what_the_expert_earns_in_a_window():
    reward = np.random.default_rng(0).normal(1.0, 1.0, 12).astype(np.float32)
    episode = np.repeat([0, 1, 2], [5, 2, 5])
    rows = Heldout(
        Latent(torch.zeros(12, 1), torch.zeros(12, 0)),
        torch.zeros(12, 2),
        *(torch.from_numpy(x) for x in (reward, reward, episode, reward)),
    )
    windows = [reward[i : i + 3].sum() for i in (0, 1, 2, 7, 8, 9)]
    assert least_gain(rows, 3, 0.1) == pytest.approx(0.1 * np.mean(windows))
    assert np.isnan(least_gain(rows, 6, 0.1))


SMALL = CounterfactualConfig(window=5, stride=2)


def judge(
    cell: Evaluated, folder: Path, config: CounterfactualConfig = SMALL, side_by_side: int = 10
) -> Mapping[str, Any]:
    folder.mkdir(exist_ok=True)
    settings = {**SETTINGS, "side_by_side": side_by_side}
    axes = {"method": "ida", "method_config": {}, "operator": cell.variant, "value": cell.value}
    read = {**cell.inputs, "evaluate": cell.path.parent}
    return CounterfactualStage().run(
        Job("counterfactual", cell.task, cell.seed, config, settings, axes, read, folder, folder)
    )


def test_the_rows_say_what_each_branch_was_and_the_summary_is_eq_19_to_21_of_them(cell, tmp_path):
    summary = judge(cell, tmp_path)
    rows = pq.read_table(tmp_path / BRANCHES_FILE).to_pylist()
    assert [path.name for path in tmp_path.iterdir()] == [BRANCHES_FILE]

    steps = read_steps(cell.path).to_pylist()
    interventions = [step for step in steps if step["deviation"] > 0]
    assert summary["interventions"] == len(interventions)
    expected = [
        (step["episode"], step["t"], step["deviation"], step["gate"])
        for step in interventions[:: SMALL.stride]
    ]
    for name in ("asst", "cf"):
        mine = [row for row in rows if row["branch"] == name]
        assert [
            (row["episode"], row["t"], row["deviation"], row["gate"]) for row in mine
        ] == expected
    assert summary["branched"] == len(expected) == len(rows) // 2 > 3

    tau_R = least_gain(load_heldout(cell.inputs["heldout"]), 5, 0.1)
    unnecessary, rho, delta_c, delta_r = [], [], [], []
    for asst, cf in zip(rows[::2], rows[1::2], strict=True):
        assert {row["tau_R"] for row in (asst, cf)} == {tau_R}
        rho.append(sum(cf["costs"]) / 5)
        delta_c.append(sum(cf["costs"]) - sum(asst["costs"]))
        delta_r.append(sum(asst["rewards"]) - sum(cf["rewards"]))
        unnecessary.append(delta_c[-1] <= 0 and delta_r[-1] <= tau_R)
    shown = {"uir": unnecessary, "rho": rho, "delta_c": delta_c, "delta_r": delta_r}
    assert {name: summary[name] for name in shown} == {
        name: pytest.approx(np.mean(values), abs=1e-4) for name, values in shown.items()
    }
    identity = {
        "task": "race1",
        "method": "ida",
        "variant": "full",
        "operator": "noisy",
        "value": 0.4,
        "seed": 0,
        "window": 5,
    }
    assert all(row.items() >= identity.items() for row in rows)


def test_a_limit_makes_the_stride_grow(cell, tmp_path):
    interventions = sum(step["deviation"] > 0 for step in read_steps(cell.path).to_pylist())
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
    with pytest.raises(TrainingError, match="no held-out episode of the expert has 11 decisions"):
        judge(cell, tmp_path, CounterfactualConfig(window=11))
