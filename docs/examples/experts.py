"""Which experts are accepted? Prints the rounds of every published expert with bars, and draws how they learned.

python docs/examples/experts.py
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

from wasp_cli.spec.load import load
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
STORE = ROOT / "results" / "published" / "store" / "expert"
PICTURE = ROOT / "docs" / "pictures" / "experts.png"
TRAININGS = (1, 2, 3, 4, 5)
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00")


def published() -> dict[tuple[str, int], Path]:
    """Return the folders of the experts by task and training."""
    spec = load(ROOT / "specs" / "table1.yaml").spec
    experts: dict[tuple[str, int], Path] = {}
    for path in STORE.glob("*/acceptance.json"):
        manifest = _read(path.with_name("_manifest.json"))
        if manifest["task"] in spec.tasks and manifest["seed"] in TRAININGS:
            experts[manifest["task"], manifest["seed"]] = path.parent
    return {(task, seed): experts[task, seed] for task in spec.tasks for seed in TRAININGS if (task, seed) in experts}


def table() -> str:
    """Return every expert's last round on 256 fresh layouts as Markdown."""
    lines = [
        "| Task | Training | Interactions | Rounds | Return | Cost | Success (%) | Accepted |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for (task, seed), folder in published().items():
        rounds = _read(folder / "acceptance.json")
        last = rounds[-1]
        numbers = (
            f"{last['interactions']:,} | {len(rounds)} | {last['return']:.1f} | {last['cost']:.1f} | {100 * last['success']:.0f}"
            f" | {'yes' if last['accepted'] else 'no'}"
        )
        lines.append(f"| {TASKS[task].title} | {seed} | {numbers} |")
    return "\n".join(lines) + "\n"


def draw() -> None:
    """Draw return and cost of the training episodes against interactions, a line for each training."""
    experts = published()
    tasks = list(dict.fromkeys(task for task, _ in experts))
    figure, axes = plt.subplots(2, len(tasks), figsize=(3.4 * len(tasks), 4.4), squeeze=False, layout="constrained", sharex="col")
    for (task, seed), folder in experts.items():
        curve: list[Mapping[str, Any]] = [row for row in _read(folder / "curve.json") if row["return"] is not None]
        x = [row["interactions"] / 1000 for row in curve]
        for axis, measure in zip(axes[:, tasks.index(task)], ("return", "cost"), strict=True):
            axis.plot(x, [row[measure] for row in curve], color=COLOURS[seed - 1], lw=1, label=f"training {seed}")
    for column, task in enumerate(tasks):
        axes[0, column].set_title(TASKS[task].title)
        axes[1, column].set_xlabel("interactions (thousands)")
    axes[0, 0].set_ylabel("return")
    axes[1, 0].set_ylabel("cost")
    axes[0, 0].legend(frameon=False)
    figure.savefig(PICTURE, dpi=110)


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    print(table())
    draw()
