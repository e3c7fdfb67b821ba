"""Print the tables of the environments in specs/away from the published rows, beside what WASP
changes in the same episodes. Nothing is computed anew, and none of the environments has to be
installed.

python docs/examples/away.py
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

import wasp_cli

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
TASKS = ("LunarLander", "PointMaze", "TakeCover", "Racetrack", "CarRacing")
METHODS = {
    "human": "Human-only",
    "ida": "IDA",
    "diffusion": "Diffusion",
    "wasp": "WASP",
    "expert": "Expert (reference)",
}
RESAMPLES = 10_000
WORLD = ["operator", "seed", "episode"]
"""What names an episode: its world, and the operator with its mistakes."""


def episodes_of(task: str, folder: Path = PUBLISHED) -> pd.DataFrame:
    """Return the episodes of a task, a row each; empty where none is published."""
    results = wasp_cli.results(folder)
    if task not in {cell.task for cell in results.cells}:
        return pd.DataFrame()
    return results.episodes(task=task).to_pandas()


def table(episodes: pd.DataFrame) -> list[list[str]]:
    """Return the rows of a task's table as a report has them: sums over the episodes of an operator
    where a measure is a share of steps, then means over the operators.
    """
    rows = []
    succeeds = bool(episodes["success"].any())
    for method, label in METHODS.items():
        mine = episodes[episodes["method"] == method]
        if mine.empty:
            continue
        means = mine.groupby("operator")[["return", "success", "cost"]].mean().mean()
        sums = mine.groupby("operator")[["cost", "env_steps", "intervened", "decisions"]].sum()
        per_1000 = (1000 * sums["cost"] / sums["env_steps"]).mean()
        intervened = (sums["intervened"] / sums["decisions"]).mean()
        row = [label, f"{means['return']:.1f}"]
        if succeeds:
            row.append(f"{100 * means['success']:.1f}")
        rows.append([*row, f"{means['cost']:.2f}", f"{per_1000:.1f}", f"{intervened:.2f}"])
    return rows


def heading(episodes: pd.DataFrame) -> list[str]:
    """Return the names of the table's columns."""
    success = ["Succ. (%) ↑"] if episodes["success"].any() else []
    return ["Return ↑", *success, "Cost ↓", "Cost/1000 ↓", "Int. ↓"]


def differences(episodes: pd.DataFrame) -> list[list[str]]:
    """Return WASP minus each other method in the same episodes: return and cost, each with the 95 %
    bootstrap interval of its mean.
    """
    wasp = episodes[episodes["method"] == "wasp"].set_index(WORLD)
    rows = []
    for method, label in METHODS.items():
        other = episodes[episodes["method"] == method].set_index(WORLD)
        if method in ("wasp", "expert") or other.empty or wasp.empty:
            continue
        row = [f"WASP - {label}"]
        for measure in ("return", "cost"):
            paired = (wasp[measure] - other[measure]).dropna().to_numpy(float)
            row.append(interval(paired))
        rows.append(row)
    return rows


def interval(differences: np.ndarray) -> str:
    """Return the mean of paired differences and its 95 % bootstrap interval, as a text."""
    source = np.random.default_rng(0)
    drawn = source.choice(differences, (RESAMPLES, len(differences))).mean(1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return f"{differences.mean():+.2f} [{low:.2f}, {high:.2f}]"


def markdown(first: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [f"| {first} | {' | '.join(columns)} |", f"| --- |{' ---: |' * len(columns)}"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join(lines)


def report(task: str, folder: Path = PUBLISHED) -> str | None:
    """Return both tables of a task, or None where no episode of it is published."""
    episodes = episodes_of(task, folder)
    if episodes.empty:
        return None
    first = markdown(task, heading(episodes), table(episodes))
    second = markdown("in the same episodes", ["return", "cost"], differences(episodes))
    return f"{first}\n\n{second}"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else PUBLISHED
    for name in TASKS:
        text = report(name, folder)
        print(f"{name}: nothing is published\n" if text is None else f"{text}\n")
