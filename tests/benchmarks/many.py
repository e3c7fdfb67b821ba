"""A grid of 5,000 cells with a million episodes, and all tables and figures of it.

python -m tests.benchmarks.many FOLDER          what wasp takes for them
python -m tests.benchmarks.many FOLDER duckdb   what DuckDB takes to pool the same columns of the
same files
"""

import json
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa

from tests.report.invented import invent
from wasp_cli.cells.cell import RecordedCell
from wasp_cli.cells.read import rows_of
from wasp_cli.metrics.episode import WEIGHTS, episode_metrics
from wasp_cli.report.render import RENDERERS
from wasp_cli.report.stats import read_frame
from wasp_cli.report.summarize import draw_figures
from wasp_cli.report.tables import main as tables_of
from wasp_cli.report.tables.comparison import comparison_table
from wasp_cli.store.layout import Layout
from wasp_cli.store.tables import (
    EPISODES_FILE,
    SCHEMA,
    CellIdentity,
    Thresholds,
    cell_tables,
    write_episodes,
)

TASKS = ("goal1", "race1", "formula1")
METHODS = ("human", "ida", "diffusion", "saferl", "wasp", "filter")
OPERATORS = {
    "noisy": (0.2, 0.4, 0.6),
    "laggy": (0.5, 0.7, 0.85),
    "limited-skill": (0.5, 0.25, 0.1),
    "reaction-time": (0.16, 0.24, 0.4),
}
SEVERITIES = ("mild", "moderate", "severe")
SEEDS = 23
EPISODES = 200


def grid() -> Iterator[tuple[CellIdentity, str | None]]:
    """Identities, and how a spec names their severity."""
    for seed in range(SEEDS):
        for task in TASKS:
            yield CellIdentity(task, "expert", "full", "none", None, seed), None
            for method in METHODS:
                for variant, values in OPERATORS.items():
                    yield from (
                        (CellIdentity(task, method, "full", variant, v, seed), name)
                        for v, name in zip(values, SEVERITIES, strict=True)
                    )


def cells() -> list[RecordedCell]:
    """The cells of the grid."""
    return [
        RecordedCell(**vars(identity), key=f"{i:020x}", severity=name)
        for i, (identity, name) in enumerate(grid())
    ]


def write(folder: Path) -> None:
    """Write all cells: one table with other identities and other numbers, since episodes would
    take minutes to invent.
    """
    episodes = [invent(e, 5, 0.2, 0.05, steps=2) for e in range(EPISODES)]
    rows = [episode_metrics(episode, 7, 25.0) for episode in episodes]
    times = [np.full(2, 2.0)] * EPISODES
    template, _ = cell_tables(
        CellIdentity("", "", "", "", None, 0),
        episodes,
        rows,
        Thresholds(0.3, 0.4),
        times,
        range(EPISODES),
    )
    rng = np.random.default_rng(0)
    layout = Layout(folder)
    for cell in cells():
        columns = {name: [value] * EPISODES for name, value in vars(cell.identity).items()}
        columns |= {
            "return": rng.normal(10, 2, EPISODES),
            "cost": rng.integers(0, 60, EPISODES),
            "int_rate": rng.random(EPISODES),
        }
        columns["episode_seed"] = np.arange(EPISODES) + 1000 * cell.seed
        table = template
        for name, values in columns.items():
            place = SCHEMA.get_field_index(name)
            table = table.set_column(
                place, SCHEMA.field(name), pa.array(values, SCHEMA.field(name).type)
            )
        path = rows_of(layout, cell)
        path.parent.mkdir(parents=True)
        write_episodes(table, path)


def peak() -> int:
    """The most memory that this process has held, in bytes."""
    status = Path("/proc/self/status")
    # the other number also has what the parent held when it started this process
    if status.exists():
        return 1024 * next(
            int(line.split()[1])
            for line in status.read_text().splitlines()
            if line.startswith("VmHWM")
        )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def pooled_by_duckdb(folder: Path, threads: int = 2) -> list[tuple[object, ...]]:
    """Pool every cell as `report.stats` does, in one query: identity, count, and the columns of
    WEIGHTS.
    """
    import duckdb

    names = tuple(CellIdentity.__dataclass_fields__)
    weights = {
        None: "1",
        "decisions": "decisions",
        "env_steps": "env_steps",
        "intervened": "intervened",
        "planned": "planned",
    }
    sums = []
    for name, weight in WEIGHTS.items():
        by = "(decisions - 1)" if name == "smoothness" else weights[weight]
        sums.append(
            f'sum("{name}"::double * {by}) / sum(case when "{name}" is null then 0 else '
            f'{by} end) as "{name}"'
        )
    query = (
        f"select {', '.join(names)}, count(*), {', '.join(sums)} from "
        f"'{folder}/store/evaluate/*/{EPISODES_FILE}' group by {', '.join(names)}"
    )
    return duckdb.connect(config={"threads": threads}).sql(query).fetchall()


def peer(folder: Path) -> None:
    """Print as JSON: seconds that DuckDB takes, the import aside, and the mean of all returns."""
    import duckdb  # noqa: F401

    begun = time.perf_counter()
    rows = pooled_by_duckdb(folder)
    place = len(CellIdentity.__dataclass_fields__) + 1 + list(WEIGHTS).index("return")
    mean = float(np.mean([float(str(row[place])) for row in rows]))
    print(
        json.dumps(
            {
                "read": time.perf_counter() - begun,
                "cpu": time.process_time(),
                "cells": len(rows),
                "return": mean,
                "peak": peak(),
            }
        )
    )


def main(folder: Path) -> None:
    """Print as JSON: seconds to read, to make and render every table and to draw every figure,
    cells, episodes, bytes held at most.
    """
    begun = time.perf_counter()
    frame = read_frame(Layout(folder), cells())
    read = time.perf_counter() - begun
    names = ("main", "ablation", "operator", "detail", "threshold", "severity", "latency")
    tables = [
        *(getattr(tables_of, f"{name}_table")(frame) for name in names),
        comparison_table(frame),
    ]
    texts = [
        render(table) for table in tables if table is not None for render in RENDERERS.values()
    ]
    tabled = time.perf_counter() - begun
    with TemporaryDirectory() as drawn:
        figures = draw_figures(Layout(folder), frame, (), Path(drawn))
    episodes = int(frame.cells.counts.sum())
    mean = float(frame.cells.pooled("return").mean())
    found = {
        "read": read,
        "tabled": tabled,
        "all": time.perf_counter() - begun,
        "cpu": time.process_time(),
        "figures": len(figures),
    }
    found |= {"cells": len(frame.cells), "episodes": episodes, "return": mean, "peak": peak()}
    print(json.dumps({**found, "characters": sum(map(len, texts))}))


if __name__ == "__main__":
    place, how = Path(sys.argv[1]), sys.argv[2:]
    if how == ["duckdb"]:
        peer(place)
    else:
        main(place)
