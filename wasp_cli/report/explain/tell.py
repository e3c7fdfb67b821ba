"""From the stored rows to the facts of an episode: totals, and runs of decisions under one gate."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from wasp_cli.report.explain.facts import Range, Run, Story, Totals, Who
from wasp_cli.report.explain.stored import GATES, Bools, Episode, Floats, number


def tell(episode: Episode) -> Story:
    """The facts of an episode."""
    row, gate = episode.row, episode.gate
    totals = Totals(
        return_=float(row["return"]),
        cost=int(row["cost"]),
        goals=int(row["goals"]),
        success=bool(row["success"]),
        costly=_places(episode.costly),
        missed=_places(episode.missed),
        intervened=_places(episode.intervened),
        int_rate=float(row["int_rate"]),
        mag_int=number(row["mag_int"]),
        gate_share={name: float((gate == value).mean()) for value, name in GATES.items() if (gate == value).any()},
        case2=number(row["case2"]),
        decision_p50_ms=number(row["decision_p50_ms"]),
        decision_p95_ms=number(row["decision_p95_ms"]),
    )
    series = {"gate": gate, **{name: episode.numbers[name] for name in ("g_cost", "deviation", "cost_env")}}
    return Story(
        who(episode), episode.thresholds, episode.constants, episode.gated, episode.selective, totals, _runs(episode), series,
        unknown(episode),
    )  # fmt: skip


def merged(runs: Sequence[Run], most: int) -> tuple[Run, ...]:
    """The runs of an episode in at most `most` pieces: short quiet ones join their neighbours first."""
    pieces = list(runs)
    while len(pieces) > max(most, 1):
        # A quiet decision between two of a gate says less than the gate: it goes before the others do.
        i = min(range(len(pieces)), key=lambda k: (pieces[k].decisions * (1 if pieces[k].gate == "none" else 3), k))
        left, right = max(i - 1, 0), min(i + 1, len(pieces) - 1)
        if left < i < right and pieces[left].gate != pieces[right].gate:
            left, right = (i, right) if pieces[right].decisions <= pieces[left].decisions else (left, i)
        pieces[left : right + 1] = [_joined(pieces[left : right + 1])]
    return tuple(pieces)


def _joined(runs: Sequence[Run]) -> Run:
    """Neighbouring runs as one."""
    sizes = [run.decisions for run in runs]
    gates: Counter[str] = Counter()
    for run in runs:
        gates.update(run.gates)
    return Run(
        first=runs[0].first,
        last=runs[-1].last,
        gates=dict(gates),
        command=_tuple(np.average([run.command for run in runs], 0, sizes)),
        executed=_tuple(np.average([run.executed for run in runs], 0, sizes)),
        deviation=float(np.average([run.deviation for run in runs], 0, sizes)),
        intervened=sum(run.intervened for run in runs),
        g_cost=_range([bound for run in runs for bound in run.g_cost or ()]),
        delta_g=_range([bound for run in runs for bound in run.delta_g or ()]),
        signal=_range([bound for run in runs for bound in run.signal or ()]),
        cost=sum(run.cost for run in runs),
        costly=tuple(t for run in runs for t in run.costly),
        missed=tuple(t for run in runs for t in run.missed),
    )


def _runs(episode: Episode) -> tuple[Run, ...]:
    marks = episode.gate if len(set(episode.gate.tolist())) > 1 else episode.costly.astype(np.int64)
    bounds = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), episode.decisions]
    return tuple(_run(episode, first, end) for first, end in pairwise(bounds))


def _run(episode: Episode, first: int, end: int) -> Run:
    """The decisions `first` ... `end - 1`."""
    part, numbers = slice(first, end), episode.numbers
    return Run(
        first=first,
        last=end - 1,
        gates=dict(Counter(GATES[value] for value in episode.gate[part].tolist())),
        command=_tuple(episode.a_h[part].mean(0)),
        executed=_tuple(episode.a[part].mean(0)),
        deviation=float(numbers["deviation"][part].mean()),
        intervened=int(episode.intervened[part].sum()),
        g_cost=_range(numbers["g_cost"][part]),
        delta_g=_range(numbers["delta_g"][part]),
        signal=_range(numbers["signal"][part]),
        cost=int(numbers["cost_env"][part].sum()),
        costly=tuple(first + t for t in _places(episode.costly[part])),
        missed=tuple(first + t for t in _places(episode.missed[part])),
    )


def who(episode: Episode) -> Who:
    """Which episode it is."""
    row, cell = episode.row, episode.cell
    variant = "" if row["assistant_variant"] == "full" else f"/{row['assistant_variant']}"
    operator = "unimpaired" if row["value"] is None else f"{row['variant']}={row['value']:g}"
    return Who(
        key=cell.key,
        label=cell.label or f"{row['task']} s{row['seed']} {row['method']}{variant} {operator}",
        path=str(cell.path),
        task=row["task"],
        method=row["method"],
        assistant_variant=row["assistant_variant"],
        operator=row["variant"],
        value=row["value"],
        seed=row["seed"],
        episode=row["episode"],
        episodes=episode.episodes,
        episode_seed=row["episode_seed"],
        decisions=episode.decisions,
        table_version=episode.version,
    )


def unknown(episode: Episode) -> tuple[str, ...]:
    """What a file of an older table version does not say."""
    if episode.version > 1 or not episode.gated:
        return ()
    return (
        "the predicted return of the commands alone (G^r)",
        "the plans: residuals, safe candidates and case per iteration, predicted cost and return",
    )


def _places(marks: Bools) -> tuple[int, ...]:
    return tuple(np.flatnonzero(marks).tolist())


def _tuple(values: Floats) -> tuple[float, ...]:
    return tuple(values.tolist())


def _range(values: Floats | Sequence[float]) -> Range | None:
    defined = [value for value in np.asarray(values, np.float64).tolist() if math.isfinite(value)]
    return (min(defined), max(defined)) if defined else None
