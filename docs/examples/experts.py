"""Which experts are accepted? Prints the last round of every expert with bars, and draws how they
learned.

`python docs/examples/experts.py` reads the published rows; with a results folder, the experts in it
are added to these rows first.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from wasp_cli.report.canvas import drawn
from wasp_cli.spec.load import load
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
ROWS = ROOT / "results" / "published" / "experts.parquet"
PICTURE = ROOT / "docs" / "pictures" / "experts.png"
TABLE1 = load(ROOT / "specs" / "table1.yaml").spec
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00")
SCHEMA = pa.schema(
    [
        ("task", pa.string()),
        ("training", pa.int8()),
        ("interactions", pa.int32()),
        ("return", pa.float32()),
        ("cost", pa.float32()),
        ("success", pa.float32()),
        ("accepted", pa.bool_()),
    ]
)
"""A row is a round on 256 fresh layouts, or, without success and accepted, the mean of the
training episodes since the row before.
"""

Rows = dict[tuple[str, int], list[dict[str, Any]]]
"""By task and training."""


def published() -> Rows:
    """Return the published rows in order."""
    rows: Rows = {(task, seed): [] for task in TABLE1.tasks for seed in TABLE1.seeds}
    for row in pq.read_table(ROWS).to_pylist() if ROWS.exists() else ():
        rows[row["task"], row["training"]].append(row)
    return {key: of for key, of in rows.items() if of}


def add(results: Path) -> None:
    """Take the experts of a results folder into the published rows, those in place of earlier
    ones of their task and training.
    """
    rows: Rows = {(task, seed): [] for task in TABLE1.tasks for seed in TABLE1.seeds} | published()
    for path in sorted((results / "store" / "expert").glob("*/acceptance.json")):
        manifest = _read(path.with_name("_manifest.json"))
        if (manifest["task"], manifest["seed"]) in rows:
            measured = [
                *_read(path),
                *(row for row in _read(path.with_name("curve.json")) if row["return"] is not None),
            ]
            who = {"task": manifest["task"], "training": manifest["seed"]}
            rows[manifest["task"], manifest["seed"]] = [
                {name: {**row, **who}.get(name) for name in SCHEMA.names} for row in measured
            ]
    table = pa.Table.from_pylist([row for key in sorted(rows) for row in rows[key]], SCHEMA)
    pq.write_table(table, ROWS, compression="zstd", compression_level=19)


def table() -> str:
    """Return every expert's last round on 256 fresh layouts as Markdown."""
    lines = [
        "| Task | Training | Interactions | Rounds | Return | Cost | Success (%) | Accepted |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for (task, seed), rows in published().items():
        rounds = [row for row in rows if row["accepted"] is not None]
        last = rounds[-1]
        numbers = (
            f"{last['interactions']:,} | {len(rounds)} | {last['return']:.1f} | "
            f"{last['cost']:.1f} | {100 * last['success']:.0f}"
            f" | {'yes' if last['accepted'] else 'no'}"
        )
        lines.append(f"| {TASKS[task].title} | {seed} | {numbers} |")
    return "\n".join(lines) + "\n"


def draw() -> None:
    """Draw return and cost of the training episodes against interactions, a line for each
    training.
    """
    experts = published()
    tasks = list(dict.fromkeys(task for task, _ in experts))
    with drawn((3.4 * len(tasks), 4.4), look={}, dpi=100) as figure:
        axes = figure.subplots(2, len(tasks), squeeze=False, sharex="col")
        for (task, seed), rows in experts.items():
            curve = [row for row in rows if row["accepted"] is None]
            x = [row["interactions"] / 1000 for row in curve]
            for axis, measure in zip(axes[:, tasks.index(task)], ("return", "cost"), strict=True):
                axis.plot(
                    x,
                    [row[measure] for row in curve],
                    color=COLOURS[seed - 1],
                    lw=1,
                    label=f"training {seed}",
                )
        for column, task in enumerate(tasks):
            axes[0, column].set_title(TASKS[task].title)
            axes[1, column].set_xlabel("interactions (thousands)")
        axes[0, 0].set_ylabel("return")
        axes[1, 0].set_ylabel("cost")
        # a task may lack a training
        lines = {line.get_label(): line for axis in axes[0] for line in axis.get_lines()}
        figure.legend(
            lines.values(), lines, loc="outside lower center", ncols=len(lines), frameon=False
        )
        figure.savefig(PICTURE, dpi=110)


def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        add(Path(folder))
    print(table())
    draw()
