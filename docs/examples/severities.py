"""Does an operator without assistance do worse at every severity? The simulated operators are made
so; this checks it.

python docs/examples/severities.py                      the published cells of specs/severity.yaml
python docs/examples/severities.py SPEC.yaml RESULTS    those of a run; `wasp run SPEC.yaml -m human
-m expert` computes no others

An operator is accepted if its return falls from every severity to the next, in the order of the
spec, and its severity `moderate` (if there is one) keeps at most three quarters of the expert's
return. Worlds of the same seed and episode are the same, so episodes are compared in pairs. What
speaks against the rule by less than two standard errors of these pairs is undecided.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

import wasp_cli
from wasp_cli.operators.registry import UNIMPAIRED
from wasp_cli.plan.reuse import lay_out_over
from wasp_cli.spec.load import load
from wasp_cli.store.layout import Layout

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "results" / "published"
MODERATE, KEPT = "moderate", 0.75
SURE = 2.0  # standard errors

Returns = dict[tuple[int, int], float]
"""The return of each world (seed, episode)."""


def difference(one: Returns, other: Returns, share: float = 1.0) -> tuple[float, float]:
    """Return mean and standard error of one - share x other over the worlds of both."""
    worlds = sorted(one.keys() & other.keys())
    values = np.array([one[world] - share * other[world] for world in worlds])
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def against(mean: float, error: float) -> str:
    """Say what a difference that should be below 0 says of the rule."""
    return "accepted" if mean < 0 else "not accepted" if mean >= SURE * error else "undecided"


def returns_of(spec: Path, folder: Path) -> dict[tuple[str, str, float | None], Returns]:
    """Read the returns of Human-only and of the Expert, by task, operator and value of the
    severity; the Expert has no value.
    """
    laid_out = lay_out_over(load(spec).spec, Layout(folder), str(PUBLISHED))
    keys = [node.key for cell, node in laid_out.cells if cell.method in ("human", "expert")]
    found: dict[tuple[str, str, float | None], Returns] = {}
    results = wasp_cli.results(folder)
    for row in (
        wasp_cli.results(folder, spec=results.specs)
        .episodes(key=keys, columns=["episode", "return"])
        .to_pylist()
    ):
        returns = found.setdefault((row["task"], row["operator"], row["value"]), {})
        returns[row["seed"], row["episode"]] = row["return"]
    return found


def check(spec: Path, folder: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yield task, operator, verdict and the returns in words."""
    found, asked = returns_of(spec, folder), load(spec).spec
    for task in asked.tasks:
        expert = found[task, UNIMPAIRED, None]
        for operator, severities in asked.operators.items():
            levels = {
                name: found[task, operator, value]
                for name, value in severities.items()
                if (task, operator, value) in found
            }
            verdicts = [
                against(*difference(severer, milder))
                for milder, severer in pairwise(levels.values())
            ]
            if MODERATE in levels:
                verdicts.append(against(*difference(levels[MODERATE], expert, KEPT)))
            worst = next(
                (word for word in ("not accepted", "undecided") if word in verdicts), "accepted"
            )
            told = [
                f"{name} {np.mean(list(returns.values())):.1f}"
                for name, returns in {"expert": expert, **levels}.items()
            ]
            yield task, operator, worst, ", ".join(told)


if __name__ == "__main__":
    arguments = [Path(argument) for argument in sys.argv[1:]] or [
        ROOT / "specs" / "severity.yaml",
        PUBLISHED,
    ]
    for line in check(*arguments):
        print("  ".join(line))
