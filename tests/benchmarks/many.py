"""A grid of 5,000 cells with a million episodes, and all tables of it: `python -m tests.benchmarks.many FOLDER` says what that takes."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from tests.report.invented import invent
from wasp_cli.metrics.episode import episode_metrics
from wasp_cli.report.render.files import RENDERERS
from wasp_cli.report.stats.frame import Wanted, read_frame
from wasp_cli.report.tables.by_axis import operator_table, severity_table
from wasp_cli.report.tables.comparison import comparison_tables
from wasp_cli.report.tables.main import ablation_table, detail_table, latency_table, main_table, threshold_table
from wasp_cli.store.tables import EPISODES_FILE, SCHEMA, CellIdentity, Thresholds, cell_tables, write_episodes

TASKS = ("goal1", "race1", "formula1")
METHODS = ("human", "ida", "diffusion", "saferl", "wasp", "filter")
OPERATORS = {
    "noisy": (0.2, 0.4, 0.6), "laggy": (0.5, 0.7, 0.85), "limited-skill": (0.5, 0.25, 0.1), "reaction-time": (0.16, 0.24, 0.4),
}  # fmt: skip
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
                        (CellIdentity(task, method, "full", variant, v, seed), name) for v, name in zip(values, SEVERITIES, strict=True)
                    )


def wanted(folder: Path) -> list[Wanted]:
    """The cells of the grid, with their places."""
    return [Wanted(identity, f"cell {i}", folder / str(i) / EPISODES_FILE, name) for i, (identity, name) in enumerate(grid())]


def write(folder: Path) -> None:
    """Write all cells: one table with other identities and other numbers, since episodes would take minutes to invent."""
    episodes = [invent(e, 5, 0.2, 0.05, steps=2) for e in range(EPISODES)]
    rows = [episode_metrics(episode, 7, 25.0) for episode in episodes]
    times = [np.full(2, 2.0)] * EPISODES
    template, _ = cell_tables(CellIdentity("", "", "", "", None, 0), episodes, rows, Thresholds(0.3, 0.4), times, range(EPISODES))
    rng = np.random.default_rng(0)
    for cell in wanted(folder):
        columns = {name: [value] * EPISODES for name, value in vars(cell.identity).items()}
        columns |= {"return": rng.normal(10, 2, EPISODES), "cost": rng.integers(0, 60, EPISODES), "int_rate": rng.random(EPISODES)}
        columns["episode_seed"] = np.arange(EPISODES) + 1000 * cell.identity.seed
        table = template
        for name, values in columns.items():
            place = SCHEMA.get_field_index(name)
            table = table.set_column(place, SCHEMA.field(name), pa.array(values, SCHEMA.field(name).type))
        cell.path.parent.mkdir()
        write_episodes(table, cell.path)


def peak() -> int:
    """The most memory that this process has held, in bytes."""
    status = Path("/proc/self/status")
    if status.exists():  # the other number also has what the parent held when it started this process
        return 1024 * next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main(folder: Path) -> None:
    """Print as JSON: seconds to read and to make and render every table, cells, episodes, bytes held at most."""
    begun = time.perf_counter()
    frame = read_frame(wanted(folder))
    read = time.perf_counter() - begun
    makers = (main_table, ablation_table, operator_table, detail_table, threshold_table, severity_table, latency_table)
    tables = [*(make(frame) for make in makers), *comparison_tables(frame)]
    texts = [render(table) for table in tables if table is not None for render in RENDERERS.values()]
    episodes = sum(cell.count for cell in frame.cells)
    found = {"read": read, "all": time.perf_counter() - begun, "cells": len(frame.cells), "episodes": episodes, "peak": peak()}
    print(json.dumps({**found, "characters": sum(map(len, texts))}))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
