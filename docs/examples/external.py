"""Our Diffusion and IDA beside the figures of their own papers: print the tables of
docs/baselines.md from the published rows.

`nox -s external` measures the rows.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

ROOT = Path(__file__).parents[2]
ROWS = ROOT / "results" / "published" / "external.parquet"
PARTS = ROOT / "results" / "published" / "external.json"
GROUPS, EPISODES = 3, 100
"""Of an evaluation, as the authors have them."""
EXPERTS = {"theirs": "The authors' experts", "ours": "Experts of our own"}
"""Who flies as the pilot, and whose flights are demonstrated."""
WORLDS = {"lander": "Lander", "reacher": "Lander-Reacher"}
PILOTS = {
    "expert": "expert",
    "noisy": "noisy",
    "laggy": "laggy",
    "laggier": "laggy",
    "zero": "no command",
}
HELPED = ("noisy", "laggy", "laggier")
"""Pilots who need help, and could do without if they were better; the verdicts are about them."""
RATIOS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
MAIN = 0.4

THEIRS: Mapping[tuple[str, str], tuple[tuple[float, float], ...]] = {
    ("lander", "expert"): (
        (77.3, 12.7),
        (73.7, 12.3),
        (78.7, 8.0),
        (32.3, 15.7),
        (29.3, 13.0),
        (29.3, 15.3),
    ),
    ("lander", "noisy"): (
        (20.7, 28.3),
        (55.7, 19.7),
        (68.0, 7.7),
        (30.7, 13.0),
        (25.7, 15.0),
        (29.0, 18.3),
    ),
    ("lander", "laggy"): (
        (21.3, 76.7),
        (52.7, 43.7),
        (75.0, 9.7),
        (33.0, 13.3),
        (23.7, 16.7),
        (26.3, 15.7),
    ),
    ("lander", "laggier"): (
        (6.0, 94.0),
        (20.7, 78.0),
        (63.0, 15.7),
        (30.3, 15.0),
        (29.3, 13.3),
        (27.7, 16.7),
    ),
    ("lander", "zero"): (
        (0.0, 100.0),
        (4.7, 86.7),
        (27.0, 19.0),
        (27.0, 15.0),
        (28.0, 15.7),
        (28.0, 13.3),
    ),
    ("reacher", "expert"): (
        (49.3, 44.0),
        (49.7, 45.0),
        (56.7, 30.0),
        (37.3, 48.0),
        (30.0, 46.0),
        (30.3, 50.3),
    ),
    ("reacher", "noisy"): (
        (14.3, 77.0),
        (20.7, 57.3),
        (45.3, 38.0),
        (30.3, 47.3),
        (29.7, 49.7),
        (30.7, 47.0),
    ),
    ("reacher", "laggy"): (
        (33.0, 67.0),
        (46.0, 47.0),
        (55.3, 31.3),
        (30.7, 50.7),
        (25.0, 52.3),
        (30.7, 45.7),
    ),
    ("reacher", "zero"): (
        (0.0, 100.0),
        (5.7, 94.3),
        (23.0, 58.3),
        (29.3, 47.0),
        (29.7, 45.7),
        (28.3, 47.0),
    ),
}
"""Success and crash in % at each of RATIOS, of three groups:
github.com/ripl/diffusion-for-shared-autonomy, `table_analysis/summary`.
"""

Cells = Mapping[tuple[str, str, str, float], tuple[float, float]]
"""(world, pilot, assistant, ratio) to success and crash in %."""


def cells_of(rows: pa.Table, expert: str) -> Cells:
    """Return the shares of every cell of an expert."""
    found: dict[tuple[str, str, str, float], list[tuple[bool, bool]]] = {}
    for row in of(rows, expert).to_pylist():
        key = (row["world"], row["pilot"], row["assistant"], row["ratio"])
        found.setdefault(key, []).append((row["reached"], row["crashed"]))
    return {
        key: (
            100 * float(np.mean([r for r, _ in ends])),
            100 * float(np.mean([c for _, c in ends])),
        )
        for key, ends in found.items()
    }


def of(rows: pa.Table, expert: str) -> pa.Table:
    """Return the rows of an expert."""
    return rows.filter(pc.equal(rows["expert"], expert))


def ours(cells: Cells, world: str, pilot: str, ratio: float) -> tuple[float, float] | None:
    """Return what our Diffusion came to at a ratio; at 0 the pilot is alone."""
    return cells.get((world, pilot, "diffusion" if ratio else "alone", ratio))


def pair(shares: tuple[float, float] | None) -> str:
    """Write success / crash."""
    return "" if shares is None else f"{shares[0]:.1f} / {shares[1]:.1f}"


def table(rows: pa.Table, expert: str) -> str:
    """Write theirs beside ours: success / crash in %, alone and assisted."""
    cells = cells_of(rows, expert)
    lines = [
        "| World | Pilot | Theirs: alone | Diffusion .4 | gain | Ours: alone | Diffusion "
        ".4 | gain | with their denoiser | IDA |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for (world, pilot), each in THEIRS.items():
        alone, assisted = ours(cells, world, pilot, 0.0), ours(cells, world, pilot, MAIN)
        if alone is None or assisted is None:
            continue
        there = each[RATIOS.index(MAIN)]
        numbers = [
            pair(each[0]),
            pair(there),
            f"{there[0] - each[0][0]:+.1f}",
            pair(alone),
            pair(assisted),
        ]
        numbers += [
            f"{assisted[0] - alone[0]:+.1f}",
            *(pair(cells.get((world, pilot, name, MAIN))) for name in ("released", "ida")),
        ]
        lines.append(
            f"| {WORLDS[world]} | {severity(rows, world, pilot)} | {' | '.join(numbers)} |"
        )
    return "\n".join(lines)


def sweep(rows: pa.Table, expert: str) -> str:
    """Write the success in % at every ratio, theirs and ours."""
    cells = cells_of(rows, expert)
    lines = [
        f"| World | Pilot | | {' | '.join(f'{ratio:g}' for ratio in RATIOS)} |",
        f"| --- | --- | --- |{' ---: |' * len(RATIOS)}",
    ]
    for (world, pilot), each in THEIRS.items():
        shares = [ours(cells, world, pilot, ratio) for ratio in RATIOS]
        if sum(share is not None for share in shares) < 2:
            continue
        numbers = {
            "theirs": [f"{share[0]:.1f}" for share in each],
            "ours": ["" if share is None else f"{share[0]:.1f}" for share in shares],
        }
        for whose, texts in numbers.items():
            first = (
                f"{WORLDS[world]} | {severity(rows, world, pilot)}" if whose == "theirs" else " | "
            )
            lines.append(f"| {first} | {whose} | {' | '.join(texts)} |")
    return "\n".join(lines)


def severity(rows: pa.Table, world: str, pilot: str) -> str:
    """Write a pilot with what is wrong with it."""
    (value,) = {
        row["value"] for row in rows.to_pylist() if (row["world"], row["pilot"]) == (world, pilot)
    }
    return f"{PILOTS[pilot]} {value:g}" if pilot in HELPED else PILOTS[pilot]


def verdicts(rows: pa.Table, expert: str) -> str:
    """Write whether what the authors found is found again, for the pilots that need help: noisy
    and laggy.
    """
    cells = cells_of(rows, expert)
    lines = [
        "| World | Pilot | Gain within ten points | Crashes at most halved | At 1 far below .4 |",
        "| --- | --- | --- | --- | --- |",
    ]
    for (world, pilot), each in THEIRS.items():
        shares = [ours(cells, world, pilot, ratio) for ratio in (0.0, MAIN, 1.0)]
        if pilot not in HELPED or shares[0] is None or shares[1] is None:
            continue
        alone, assisted, free = shares
        there = each[RATIOS.index(MAIN)]
        gain, wanted = assisted[0] - alone[0], there[0] - each[0][0]
        told = [f"{mark(abs(gain - wanted) <= 10)} ({gain:+.1f}, theirs {wanted:+.1f})"]
        told.append(
            f"{mark(assisted[1] <= alone[1] / 2)} (to {share_left(alone, assisted)}, "
            f"theirs {share_left(each[0], there)})"
        )
        behind = there[0] - each[-1][0]
        told.append(
            ""
            if free is None
            else f"{mark(assisted[0] - free[0] >= behind / 2)} ({free[0] - assisted[0]:+.1f}, "
            f"theirs {-behind:+.1f})"
        )
        lines.append(f"| {WORLDS[world]} | {severity(rows, world, pilot)} | {' | '.join(told)} |")
    return "\n".join(lines)


def mark(holds: bool) -> str:
    """Write whether something holds."""
    return "yes" if holds else "**no**"


def share_left(alone: tuple[float, float], assisted: tuple[float, float]) -> str:
    """Write how many of the crashes are left."""
    return f"{100 * assisted[1] / alone[1]:.0f} %" if alone[1] else "none of none"


def parts(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Write what the denoisers learned, how near they bring commands to those of the expert,
    and how long everything took.
    """
    lines = [
        "| Expert | World | Its decisions | Demonstrated | Updates | Noise loss | of "
        "others | Distance to the expert's command: uniform "
        "| after .2 | after .4 | its own, after .4 | Minutes: expert | flights | denoiser |",
        "| --- | --- |" + " ---: |" * 12,
    ]
    for whose in (name for name in EXPERTS if name in found):
        for world, each in found[whose].items():
            denoiser, minutes = each["denoiser"], each["minutes"]
            near = denoiser["quality"]
            numbers = [
                f"{each['learned']:,}" if "learned" in each else "",
                f"{denoiser['demonstrations']:,.0f}",
            ]
            numbers += [f"{denoiser['updates']:,} x {denoiser['batch']}"]
            numbers += [f"{denoiser['noise_loss']:.3f}", f"{denoiser['heldout_noise_loss']:.3f}"]
            numbers += [
                f"{near['uniform'][ratio]['conformity']:.2f}" for ratio in ("0", "0.2", "0.4")
            ]
            numbers += [f"{near['expert']['0.4']['conformity']:.2f}"]
            numbers += [
                f"{minutes[part]:.0f}" if part in minutes else ""
                for part in ("expert", "demonstrations", "denoiser")
            ]
            lines.append(f"| {EXPERTS[whose]} | {WORLDS[world]} | {' | '.join(numbers)} |")
    return "\n".join(lines)


def page() -> str:
    """Write all tables of the page from what is published."""
    rows = pq.read_table(ROWS)
    whose = [expert for expert in EXPERTS if len(of(rows, expert))]
    tables = [
        f"{EXPERTS[expert]}\n\n"
        + "\n\n".join(write(rows, expert) for write in (table, verdicts, sweep))
        for expert in whose
    ]
    return "\n\n".join([*tables, parts(json.loads(PARTS.read_text()))])


if __name__ == "__main__":
    print(page())
