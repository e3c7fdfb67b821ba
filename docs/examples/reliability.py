"""What were the predictions of WASP worth? Print the tables of docs/planner_measured.md.

python docs/examples/reliability.py         from the published branches of `field` and `table1`

A gate fires where the model predicts a gain: the task gate for return, the safety gate against
cost. The published branches say what happened (`wasp_cli.metrics.gains`). Predictions are published
for the first episode of each cell alone, and the branches of all episodes: what the task gate
corrected was predicted to gain more than tau_r, whether the prediction is there or not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wasp_cli.cells.cell import stored_cells
from wasp_cli.metrics.episode import GATE_SAFETY, GATE_TASK
from wasp_cli.metrics.gains import (
    CLUSTERS,
    Interval,
    discounted,
    flatness,
    gain_bins,
    holds_from,
    mean_interval,
)
from wasp_cli.metrics.necessity import ALONE, ASSISTED
from wasp_cli.plan.grid import COUNTERFACTUAL
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.artifact import read_manifest
from wasp_cli.store.branches import BRANCHES_FILE, read_branches
from wasp_cli.store.find import KIND
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import cell_file, read_episodes, read_steps
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
SPECS = ("field", "table1")
TASKS_SHOWN = ("race1", "formula1", "goal1")
METHODS = {"wasp": "WASP", "printed": "as printed"}
GATES = {"return gained": GATE_TASK, "cost saved": GATE_SAFETY}
"""What is predicted, and the gate that fires for it."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Intervention:
    """A branched intervention: what it gained, and what it was predicted to gain (NaN: not
    published), discounted.
    """

    task: str
    method: str
    gate: int
    episode: tuple[str, int, int]  # operator, seed and number
    realised: float
    predicted: float
    tau_r: float


@cache
def interventions(spec: str) -> tuple[Intervention, ...]:
    """Read the branched interventions of the published cells of a spec."""
    asked = load(ROOT / "specs" / f"{spec}.yaml").spec
    laid_out = lay_out_over(asked, Layout(Path("nowhere")), str(PUBLISHED))
    keys = {node.key for cell, node in laid_out.cells if cell.method in METHODS}
    layout = Layout(PUBLISHED)
    cells = [cell for cell in stored_cells(layout) if cell.key in keys and cell.branches]
    return tuple(one for cell in cells for one in _of_cell(layout, cell.key, cell.branches or ""))


def _of_cell(layout: Layout, evaluation: str, branches: str) -> Iterator[Intervention]:
    path = cell_file(layout.artifact(KIND, evaluation))
    (tau_r,) = set(read_episodes([path])["tau_r"].to_pylist())
    returns = read_manifest(layout, KIND, evaluation)["settings"]["returns"]
    stored = read_branches(layout.artifact(COUNTERFACTUAL, branches) / BRANCHES_FILE)
    cell = stored.cell.identity

    # What was predicted, by episode and decision.
    gains: dict[tuple[int, int], float] = {}
    savings: dict[tuple[int, int], float] = {}
    for step in read_steps(path).to_pylist():
        if step["plan_return"] is not None:
            decision = step["episode"], step["t"]
            gains[decision] = step["plan_return"] - step["alone_return"]
            savings[decision] = step["alone_cost"] - step["plan_cost"]

    # What happened.
    gained = discounted(stored.reward[ASSISTED] - stored.reward[ALONE], returns["gamma_r"])
    saved = discounted(stored.cost[ALONE] - stored.cost[ASSISTED], returns["gamma_c"])
    for i, decision in enumerate(zip(stored.episode.tolist(), stored.t.tolist(), strict=True)):
        task_gate = stored.gate[i] == GATE_TASK
        predicted = gains if task_gate else savings
        yield Intervention(
            cell.task,
            cell.method,
            int(stored.gate[i]),
            (cell.operator, cell.seed, decision[0]),
            float(gained[i] if task_gate else saved[i]),
            predicted.get(decision, np.nan),
            tau_r,
        )


def chosen(spec: str, task: str, method: str, gate: int) -> list[Intervention]:
    """Return the interventions of one gate of an assistant on a task."""
    return [
        one
        for one in interventions(spec)
        if (one.task, one.method, one.gate) == (task, method, gate)
    ]


def realised_table(method: str) -> str:
    """Write what all branched interventions of an assistant gained, with or without a published
    prediction; the intervals are over worlds, each with its operators.
    """
    lines = [
        "| Gate's gain | Task | Spec | Interventions, worlds | tau_r | Realised |",
        "| --- | --- | --- | ---: | ---: | ---: |",
    ]
    for (name, gate), task, spec in product(GATES.items(), TASKS_SHOWN, SPECS):
        found = chosen(spec, task, method, gate)
        worlds = np.array([f"{one.episode[1]}/{one.episode[2]}" for one in found])
        realised = np.array([one.realised for one in found])
        limits = mean_interval(realised, worlds)
        counted = len(np.unique(worlds))
        thresholds = sorted({one.tau_r for one in found})
        lines.append(
            f"| {name} | {TASKS[task].title} | `{spec}` "
            f"| {len(found)}, {counted} | {_span(thresholds, gate)} "
            f"| {_estimate(realised.mean(), limits, counted)} |"
        )
    return "\n".join(lines)


def predicted_table() -> str:
    """Write predicted beside realised gains where predictions are published; the intervals are
    over episodes, which are one or two worlds under four operators.
    """
    lines = [
        "| | Task | Gate's gain | Interventions, episodes | Predicted | Realised | Slope "
        "| Rank corr. | Holds from |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for method, (name, gate), task in product(METHODS, GATES.items(), TASKS_SHOWN):
        found = with_predictions(task, method, gate)
        if len(found) > 1:
            lines.append(_predicted_row(found, f"{TASKS[task].title} | {name}"))
    return "\n".join(lines)


def with_predictions(task: str, method: str, gate: int) -> list[Intervention]:
    """Return the interventions of both specs whose predictions are published."""
    found = [one for spec in SPECS for one in chosen(spec, task, method, gate)]
    return [one for one in found if not np.isnan(one.predicted)]


def columns_of(found: Sequence[Intervention]) -> tuple[Floats, Floats, NDArray[np.str_]]:
    """Return predicted and realised gains and episodes [N]."""
    predicted = np.array([one.predicted for one in found])
    realised = np.array([one.realised for one in found])
    episodes = np.array(["/".join(map(str, one.episode)) for one in found])
    return predicted, realised, episodes


def _predicted_row(found: Sequence[Intervention], label: str) -> str:
    predicted, realised, episodes = columns_of(found)
    flat = flatness(predicted, realised, episodes)
    holds = holds_from(predicted, realised, episodes)
    counted = len(np.unique(episodes))
    too_few = "too few" if counted < CLUSTERS else "nowhere"
    return (
        f"| {METHODS[found[0].method]} | {label} | {len(found)}, {counted} "
        f"| {_number(predicted.mean())} "
        f"| {_estimate(realised.mean(), mean_interval(realised, episodes), counted)} "
        f"| {_estimate(flat.slope, flat.slope_interval, counted)} "
        f"| {_estimate(flat.rank, flat.rank_interval, counted)} "
        f"| {too_few if holds is None else f'{holds:.3f}'} |"
    )


def bins_table(method: str, gate: int) -> str:
    """Write the bins of predicted gains, task by task."""
    lines = [
        "| Task | Predicted | Realised | Interventions |",
        "| --- | ---: | ---: | ---: |",
    ]
    for task in TASKS_SHOWN:
        columns = columns_of(with_predictions(task, method, gate))
        counted = len(np.unique(columns[2]))
        for each in gain_bins(*columns):
            lines.append(
                f"| {TASKS[task].title} | {_number(each.predicted)} "
                f"| {_estimate(each.realised, each.interval, counted)} | {each.size} |"
            )
    return "\n".join(lines)


def _number(value: float) -> str:
    return "n/a" if np.isnan(value) else f"{round(value, 3) + 0.0:.3f}"


def _estimate(value: float, limits: Interval, clusters: int) -> str:
    """Write a number with its interval; without it where so few clusters were resampled that it
    says nothing.
    """
    if clusters < CLUSTERS or np.isnan(limits.low):
        return _number(value)
    return f"{_number(value)} [{_number(limits.low)}, {_number(limits.high)}]"


def _span(thresholds: Sequence[float], gate: int) -> str:
    if gate != GATE_TASK:
        return ""
    least, most = f"{thresholds[0]:.3f}", f"{thresholds[-1]:.3f}"
    return least if least == most else f"{least} to {most}"


if __name__ == "__main__":
    for method in METHODS:
        print(f"### {METHODS[method]}\n\n{realised_table(method)}\n")
    print(f"### With a published prediction\n\n{predicted_table()}\n")
    print(f"### The task gate of WASP\n\n{bins_table('wasp', GATE_TASK)}")
