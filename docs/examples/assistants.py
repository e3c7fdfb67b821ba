"""How do the assistants compare on fresh seeds, and under operators that no choice has seen? Print
the tables of docs/assistants.md.

python docs/examples/assistants.py SPEC     from the published cells of `field`, `unseen`,
`goal1-two` or `operators`
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

import wasp_cli
from wasp_cli.methods.registry import METHODS
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout
from wasp_cli.tasks.registry import TASKS

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
TASKS_SHOWN = ("race1", "formula1", "goal1", "goal1-two")
UNIMPAIRED = "unimpaired"
GROUPS = {
    "Operators on which choices were made": ("noisy", "laggy", "limited-skill", "reaction-time"),
    "Operators that no choice has seen": (
        "noisy-gaussian",
        "noisy-burst",
        "delayed-noisy",
        "reactive",
    ),
    "The unimpaired expert": (UNIMPAIRED,),
}
OPPONENTS = ("ida", "ida-guarded", "diffusion", "csa", "saferl", "reach", "mpmi", "printed")
SUMS = (
    "decisions",
    "intervened",
    "effective",
    "deviation",
    "branched",
    "unnecessary",
    "swapped",
    "ms",
)
RESAMPLES = 1000
COLUMNS_READ = (
    "episode",
    "return",
    "success",
    "cost",
    "decisions",
    "intervened",
    "int_eff",
    "mag",
    "decision_p50_ms",
)

Cells = Mapping[tuple[str, str, str], Mapping[tuple[int, int], list[float]]]
"""Of every task, method and operator what each world (seed, episode) came to."""
Sums = NDArray[np.float64]
"""[operators, worlds, measures]: return, success and cost of an episode, then SUMS."""


@cache
def published(spec: str) -> pa.Table:
    """Return a row for each published episode of a spec, with what its branches say."""
    return pa.Table.from_pylist(list(rows_of(spec)))


def rows_of(spec: str) -> Iterator[dict[str, Any]]:
    """Yield a row for each episode of the published cells of a spec, with what its branches say."""
    asked = load(ROOT / "specs" / f"{spec}.yaml").spec
    cells = {
        node.key for _, node in lay_out_over(asked, Layout(Path("nowhere")), str(PUBLISHED)).cells
    }
    run = wasp_cli.results(PUBLISHED)
    chosen = sorted(cell.key for cell in run.cells if cell.key in cells)
    branches: dict[tuple[Any, ...], list[tuple[bool, bool]]] = {}
    for row in run.branches(
        key=chosen, columns=["episode", "unnecessary", "unnecessary_swapped"]
    ).to_pylist():
        branches.setdefault((row["key"], row["episode"]), []).append(
            (row["unnecessary"], row["unnecessary_swapped"])
        )
    judged = {key for key, _ in branches}
    order = {name: i for i, name in enumerate(asked.methods)}
    for row in sorted(
        run.episodes(key=chosen, columns=COLUMNS_READ).to_pylist(),
        key=lambda row: order.get(row["method"], 0),
    ):
        tested = branches.get((row["key"], row["episode"]), []) if row["key"] in judged else None
        yield {
            "task": row["task"],
            "method": row["method"],
            "operator": row["operator"] if row["value"] is not None else UNIMPAIRED,
            "seed": row["seed"],
            "episode": row["episode"],
            "return": row["return"],
            "success": float(row["success"]),
            "cost": float(row["cost"]),
            "decisions": row["decisions"],
            "intervened": row["intervened"],
            "effective": round(row["int_eff"] * row["decisions"]),
            "deviation": row["mag"] * row["decisions"],
            "ms": row["decision_p50_ms"],
            "branched": None if tested is None else len(tested),
            "unnecessary": None if tested is None else sum(alone for alone, _ in tested),
            "swapped": None if tested is None else sum(mirror for _, mirror in tested),
        }


def sums_of(rows: pa.Table) -> Cells:
    """Return what every world came to."""
    cells: dict[tuple[str, str, str], dict[tuple[int, int], list[float]]] = {}
    for row in rows.to_pylist():
        numbers = [
            np.nan if row.get(name) is None else float(row[name])
            for name in ("return", "success", "cost", *SUMS)
        ]
        cells.setdefault((row["task"], row["method"], row["operator"]), {})[
            row["seed"], row["episode"]
        ] = numbers
    return cells


def cube(cells: Cells, task: str, method: str, group: tuple[str, ...], beside: str = "") -> Sums:
    """Return [operators, worlds, measures] of the operators of a group that a method met, in worlds
    common to them and another one.

    A reference met nobody but itself.
    """
    alone = not METHODS[method].impaired
    operators = [
        name for name in ((UNIMPAIRED,) if alone else group) if (task, method, name) in cells
    ]
    met = [
        set(cells[task, each, name]) for each in (method, beside or method) for name in operators
    ]
    worlds = sorted(set.intersection(*met)) if met else []
    return np.array([[cells[task, method, name][world] for world in worlds] for name in operators])


def measures(sums: Sums) -> dict[str, Any]:
    """Pool the worlds of each operator, and average over operators: [operators, worlds,
    measures], or [operators, R, worlds, measures].
    """
    mean, total = sums.mean(-2), sums.sum(-2)
    share = {
        name: (total[..., 3 + SUMS.index(name)] / total[..., 3]).mean(0)
        for name in ("intervened", "effective", "deviation")
    }
    with np.errstate(invalid="ignore"):  # of worlds that were branched, if any
        judged, unnecessary, swapped = (
            np.nansum(sums[..., 3 + SUMS.index(name)], axis=(0, -1))
            for name in ("branched", "unnecessary", "swapped")
        )
        uir, mirror = unnecessary / judged, swapped / judged
    return {
        "return": mean[..., 0].mean(0),
        "success": 100 * mean[..., 1].mean(0),
        "cost": mean[..., 2].mean(0),
        **share,
        "uir": uir,
        "mirror": mirror,
        "ms": mean[..., 3 + SUMS.index("ms")].mean(0),
    }


def shown_tasks(cells: Cells) -> list[str]:
    """Return the tasks that there are, in the order of tables."""
    return [task for task in TASKS_SHOWN if any(place == task for place, _, _ in cells)]


def matrix(rows: pa.Table) -> str:
    """Write return / cost of every assistant under every operator."""
    cells = sums_of(rows)
    operators = [
        name for name in dict.fromkeys(operator for _, _, operator in cells) if name != UNIMPAIRED
    ]
    lines = [
        f"| Task | Method | {' | '.join(operators)} |",
        "| --- | --- |" + " ---: |" * len(operators),
    ]
    for task in shown_tasks(cells):
        first = TASKS[task].title
        for method in dict.fromkeys(name for place, name, _ in cells if place == task):
            each = [
                measures(cube(cells, task, method, (name,)))
                if (task, method, name) in cells
                else None
                for name in operators
            ]
            if any(each):
                numbers = [
                    "" if m is None else f"{m['return']:.1f} / {m['cost']:.1f}" for m in each
                ]
                lines.append(f"| {first} | {METHODS[method].title} | {' | '.join(numbers)} |")
                first = ""
    return "\n".join(lines)


COLUMNS = (
    "Task",
    "Method",
    "Return",
    "Succ. (%)",
    "Cost",
    "Int.",
    "effective",
    "Mag.",
    "UIR",
    "mirror",
    "ms",
)
DIGITS = (1, 0, 1, 2, 2, 2, 2, 2, 1)
"""Of each measure, in the order of `measures`."""


def table(rows: pa.Table, group: str) -> str:
    """Write what every assistant came to under a group of operators, without columns that
    nobody has.
    """
    cells = sums_of(rows)
    lines: list[list[str]] = []
    for task in shown_tasks(cells):
        first = TASKS[task].title
        for method in dict.fromkeys(name for place, name, _ in cells if place == task):
            sums = cube(cells, task, method, GROUPS[group])
            if sums.size:
                m = measures(sums)
                numbers = [
                    "" if np.isnan(value) else f"{value:.{digits}f}"
                    for value, digits in zip(m.values(), DIGITS, strict=True)
                ]
                lines.append([first, METHODS[method].title, *numbers])
                first = ""
    kept = [i for i in range(len(COLUMNS)) if any(line[i] for line in lines)]
    rules = ["---", "---", *["---:"] * len(DIGITS)]
    return "\n".join(
        f"| {' | '.join(line[i] for i in kept)} |" for line in (COLUMNS, rules, *lines)
    )


def short(rows: pa.Table, group: str = next(iter(GROUPS))) -> str:
    """Write return / cost of every assistant on every task under a group of operators, as in
    README.
    """
    cells = sums_of(rows)
    tasks = shown_tasks(cells)
    lines = [
        f"| Return / cost | {' | '.join(TASKS[task].title for task in tasks)} |",
        "| --- |" + " ---: |" * len(tasks),
    ]
    for method in dict.fromkeys(name for _, name, _ in cells):
        sums = [cube(cells, task, method, GROUPS[group]) for task in tasks]
        numbers = [
            f"{m['return']:.1f} / {m['cost']:.1f}" if m else ""
            for m in (measures(cells) if cells.size else None for cells in sums)
        ]
        lines.append(f"| {METHODS[method].title} | {' | '.join(numbers)} |")
    return "\n".join(lines)


def differences(rows: pa.Table, group: str) -> str:
    """Write WASP minus others: paired over the worlds, 95 % bootstrap over worlds, each with
    its operators.
    """
    cells, shown = sums_of(rows), ("return", "cost", "intervened", "deviation", "uir")
    lines = [
        "| Task | WASP minus | Return | Cost | Int. | Mag. | UIR |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for task in shown_tasks(cells):
        first = TASKS[task].title
        for method in OPPONENTS:
            met = tuple(name for name in GROUPS[group] if (task, method, name) in cells)
            if not met:
                continue
            other, ours = (
                cube(cells, task, method, met, "wasp"),
                cube(cells, task, "wasp", met, method),
            )
            random = np.random.default_rng(0)
            drawn = random.integers(ours.shape[1], size=(RESAMPLES, ours.shape[1]))
            texts = []
            here, there = measures(ours), measures(other)
            left, right = measures(ours[:, drawn]), measures(other[:, drawn])
            for key in shown:
                if np.isnan(here[key] - there[key]):
                    texts.append("")
                    continue
                low, high = np.nanpercentile(left[key] - right[key], [2.5, 97.5])
                digits = 1 if key in ("return", "cost") else 2
                texts.append(
                    f"{here[key] - there[key]:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"
                )
            lines.append(f"| {first} | {METHODS[method].title} | {' | '.join(texts)} |")
            first = ""
    return "\n".join(lines)


if __name__ == "__main__":
    rows = published(sys.argv[1] if len(sys.argv) > 1 else "field")
    met = set(rows["operator"].to_pylist())
    for name in [name for name in GROUPS if met & set(GROUPS[name])]:
        print(f"### {name}\n\n{table(rows, name)}\n\n{differences(rows, name)}\n")
    print(matrix(rows))
