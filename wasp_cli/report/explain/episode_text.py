"""An episode as tables: outcome, gates, a strip of characters over time, and its runs of decisions under one gate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from wasp_cli.metrics.episode import GATE_LATE, GATE_METHOD, GATE_NONE, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.collect import merge_runs
from wasp_cli.report.explain.facts import EpisodeSummary, Run, exceeds
from wasp_cli.report.explain.layout import (
    INDENT,
    STYLES,
    action,
    between,
    cell_fields,
    cost_meaning,
    count,
    decider,
    fields,
    gain_meaning,
    heading,
    ms,
    notes,
    places,
    plain,
    sentence,
    short,
    span,
    table,
)
from wasp_cli.report.explain.stored import signal_of

MOST_RUNS = 24
"""Rows of the table of runs at most, so that an episode stays below 60 lines."""

BLOCKS = "▁▂▃▄▅▆▇█"
LABEL = 12
SILENT = ("·", "dim", "")
LETTERS = {
    GATE_SAFETY: ("S", "yellow", "safety"), GATE_TASK: ("T", "cyan", "task"), GATE_METHOD: ("M", "magenta", "the method's own"),
    GATE_LATE: ("L", "red", "late"),
}  # fmt: skip


def episode_lines(summary: EpisodeSummary, width: int, command: str = "wasp explain CELL") -> list[Text]:
    """Set out an episode, in lines of at most `width` columns where words allow it.

    Args:
        summary: the facts.
        width: columns of the terminal.
        command: what explains this cell, for the hint at the end.
    """
    who, totals = summary.who, summary.totals
    lines = [heading(f"{who.label} · episode {who.episode}", f"of 0 to {who.episodes - 1}"), *sentence(_headline(summary), width), Text()]
    lines += fields([*cell_fields(who), *_outcome(summary)], width)
    if summary.selective:
        lines += [Text(), heading("Gates" if summary.gated else "Decisions"), *_gates(summary, width)]
    strip = strip_lines(summary, width)
    if strip:
        lines += [Text(), heading("Over the episode"), *strip]
    pieces = merge_runs(summary.runs, MOST_RUNS)
    lines += [Text(), heading("Runs of decisions"), *_runs(summary, pieces, width), *notes(width, _legend(summary, pieces))]
    telling = (totals.missed, totals.intervened, totals.costly) if summary.selective else (totals.costly, totals.intervened)
    place = next((decisions[0] for decisions in telling if decisions), 0)
    lines.append(Text(f"{' ' * INDENT}one decision in full: {command} --episode {who.episode} --step {place}", "dim"))
    return lines


def _headline(summary: EpisodeSummary) -> str:
    totals, decisions = summary.totals, summary.who.decisions
    changed = f"{len(totals.intervened)} of {count(decisions, 'command')} changed" if totals.intervened else "No command changed"
    missed = f", {len(totals.missed)} of them missed (no gate fired)" if totals.costly and summary.selective else ""
    late = f", {len(totals.late)} while the assistant was late" if totals.late else ""
    return f"{changed}; {count(len(totals.costly), 'decision') if totals.costly else 'no decision'} with cost{missed}{late}."


def _outcome(summary: EpisodeSummary) -> list[tuple[str, str]]:
    totals, constants, many = summary.totals, summary.constants, summary.who.episodes
    outcome = f"return {plain(totals.return_)}, {count(totals.goals, 'goal')} ({'success' if totals.success else 'no success'})"
    outcome += f", {count(summary.who.decisions, 'decision')}"
    if constants.action_repeat is not None:
        outcome += f" of {count(constants.action_repeat, 'env step')}"
    if constants.decision_seconds is not None:
        outcome += f" ({constants.decision_seconds:g} s)"
    cost = count(totals.cost, "env step")
    if totals.costly:
        cost += f", in {count(len(totals.costly), 'decision')}"
        foreseen = len(totals.costly) - len(totals.missed) - len(totals.late)
        cost += f": {len(totals.missed)} missed, {foreseen} although a gate fired" if summary.selective else ""
        cost += f", {len(totals.late)} while the assistant was late" if totals.late else ""
    size = "" if totals.mag_int is None else f", by {totals.mag_int:.2f} on average (|a - a^H|)"
    entries = [
        ("outcome", outcome),
        ("cost", cost),
        ("changed", f"{count(len(totals.intervened), 'decision')} ({totals.int_rate:.1%}, Int.){size}" if totals.intervened else "none"),
    ]
    if totals.case2 is not None:
        entries.append(("Case II", f"{totals.case2:.0%} of the planner's iterations: too few safe candidates"))
    if totals.decision_p50_ms is None or totals.decision_p95_ms is None:
        return [*entries, ("time", "not recorded")]
    shared = "" if many == 1 else f"; the time of all {many} episodes, decided side by side, divided by {many}"
    return [*entries, ("time", f"{ms(totals.decision_p50_ms)} per decision (p50), {ms(totals.decision_p95_ms)} (p95){shared}")]


def _gates(summary: EpisodeSummary, width: int) -> list[Text]:
    """Return how often each gate fired, and above which value it does."""
    who, thresholds, series = summary.who, summary.thresholds, summary.series["gate"]
    kept = np.ones(len(series), bool)
    kept[list(summary.totals.intervened)] = False
    signal, off = signal_of(who.method), "off in this variant"
    above = "-" if summary.gated or summary.signal_limit is None else f"{signal.name} > {short(summary.signal_limit)}"
    gates = [(GATE_METHOD, decider(who.method), above), (GATE_NONE, "none", "-")]
    if summary.gated:
        safety = off if who.variant == "task-only" else f"G^c > τ_c {short(thresholds.tau_c)}"
        task = off if who.variant == "safety-only" else f"ΔG > τ_r {short(thresholds.tau_r)}"
        gates[:1] = [(GATE_SAFETY, "safety", safety), (GATE_TASK, "task", task), *(gates[:1] if (series == GATE_METHOD).any() else [])]
    if (series == GATE_LATE).any():
        gates.append((GATE_LATE, "late", "no answer in time"))
    rows = []
    for gate, name, where in gates:
        fired, stood = series == gate, int((kept & (series == gate)).sum()) if gate not in (GATE_NONE, GATE_LATE) else 0
        rows.append([name, where, str(int(fired.sum())), f"{fired.mean():.1%}", str(stood) if stood else "-"])
    said = [cost_meaning(summary.constants), gain_meaning(summary.constants)] if summary.gated else [f"{signal.name}: {signal.meaning}"]
    if any(row[-1] != "-" for row in rows):
        said.append("command kept: a gate fired, and the command was executed as it was")
    if (series == GATE_LATE).any():
        said.append("late: the assistant had not answered in time, no gate was asked, and the command was executed as it was")
    return table(["gate", "fires where", "decisions", "share", "command kept"], rows, width) + notes(width, *said)


def _runs(summary: EpisodeSummary, pieces: Sequence[Run], width: int) -> list[Text]:
    tau_c, tau_r, method = summary.thresholds.tau_c, summary.thresholds.tau_r, summary.who.method
    changed, change, signal = "changed", "command → executed (means)", signal_of(method).name
    cost, gain = f"G^c (τ_c {short(tau_c)})", f"ΔG (τ_r {short(tau_r)})"
    rows = [
        [
            span(run.first, run.last), _gate(run, method) if summary.selective else "-", _changed(run), _change(run),
            between(run.g_cost, tau_c), between(run.delta_g, tau_r), between(run.signal, None),
            str(run.cost) if run.cost else "-", places(run.missed),
        ]
        for run in pieces
    ]  # fmt: skip
    titles = ["decisions", "gate", changed, change, cost, gain, signal, "cost", "missed at"]
    lines = table(titles, rows, width, [STYLES[run.gate] for run in pieces], drop=[gain, signal, change, changed])
    for line, run in zip(lines[1:], pieces, strict=True):
        if run.missed:  # the last column
            line.stylize("bold red", len(line) - len(places(run.missed)))
    return lines


def _gate(run: Run, method: str) -> str:
    """`safety`, or of merged runs `safety 12/15`."""
    name = {"none": "-", "method": decider(method)}.get(run.gate, run.gate)
    return name if len(run.gates) == 1 else f"{name} {run.gates[run.gate]}/{run.decisions}"


def _changed(run: Run) -> str:
    if not run.intervened:
        return "-"
    return f"{run.intervened} of {run.decisions}, by {plain(run.deviation * run.decisions / run.intervened)}"


def _change(run: Run) -> str:
    return f"{action(run.command)} → {action(run.executed)}" if run.intervened else f"{action(run.command)} as commanded"


def _legend(summary: EpisodeSummary, pieces: Sequence[Run]) -> str:
    totals = summary.totals
    parts = ["changed: decisions with another action than the command, and by how much (|a - a^H|)"] if totals.intervened else []
    parts += ["cost: env steps with cost"] if totals.costly else []
    parts += ["missed: cost, and no gate fired"] if totals.missed else []
    if len(pieces) < len(summary.runs):
        parts.append(f"{len(summary.runs)} runs in {len(pieces)} rows, short ones merged: 'safety 12/15' is 12 of 15 decisions")
    if len(totals.gate_share) == 1 and len(summary.runs) > 1:
        why = "the gate never changed, so " if summary.selective else ""
        parts.append(f"{why}the rows are stretches with and without cost")
    return "; ".join(parts)


def strip_lines(summary: EpisodeSummary, width: int) -> list[Text]:
    """Draw the safety gate's value over time, the gates below it and the costs below them.

    Returns none where there is nothing to draw (no gate's value, no intervention).
    """
    value, full, name = _measure(summary)
    if not full:
        return []
    per = max(1, math.ceil(len(value) / max(20, width - LABEL - 2)))
    groups = [slice(start, start + per) for start in range(0, len(value), per)]
    limit = summary.thresholds.tau_c if name == "G^c" else None
    curve: list[tuple[str, str]] = []  # a character and its style per column
    gates, costs = curve.copy(), curve.copy()
    missed = set(summary.totals.missed)
    for part in groups:
        height = _greatest(value[part])
        curve.append((_block(height, full), "" if limit is None else "red" if exceeds(height, limit) else "green"))
        gates.append(LETTERS.get(_strongest(summary.series["gate"][part]), SILENT)[:2])
        paid = [t for t in range(part.start, min(part.stop, len(value))) if summary.series["cost_env"][t] > 0]
        costs.append(("!" if missed.intersection(paid) else "x", "bold red") if paid else SILENT[:2])
    seen = {gate for gate in LETTERS if (summary.series["gate"] == gate).any() and summary.selective}
    last = str(len(value) - 1)
    axis = Text(_label("decision") + "0" + last.rjust(max(len(groups) - 1, len(last) + 1)), "dim")
    lines = [_line(name, curve)]
    if seen:
        lines.append(_line("gate", gates))
    if summary.totals.costly:
        lines.append(_line("cost", costs))
    scale = [f"█ is {full:.3g}" if limit is None else f"▁▂▃▄ up to τ_c = {limit:.3g}, ▅▆▇█ above it"]
    scale += [f"{LETTERS[gate][0]} {LETTERS[gate][2]}" for gate in LETTERS if gate in seen]
    scale += ["x cost" if not missed else "x cost, ! cost that every gate missed"] if summary.totals.costly else []
    scale += [f"a column is the maximum of {per} decisions"] if per > 1 else []
    return [*lines, axis, *notes(width, "; ".join(scale))]


def _measure(summary: EpisodeSummary) -> tuple[NDArray[np.float64], float, str]:
    """What is drawn [T], the value of a full block, and its name."""
    cost, size = summary.series["g_cost"], summary.series["deviation"]
    limit = summary.thresholds.tau_c
    if summary.gated and np.isfinite(cost).any():
        # Half of the height is the threshold: what stands above the middle has fired, without any colour.
        return cost, 2 * float(np.float32(limit)) if limit is not None and limit > 0 else float(np.nanmax(cost)), "G^c"
    return size, float(size.max()), "|a - a^H|"


def _block(height: float, full: float) -> str:
    """A value up to half of `full` is in the lower four blocks, the half itself too."""
    if math.isnan(height):
        return " "
    return BLOCKS[min(max(math.ceil(8 * height / full) - 1, 0), 7)] if full > 0 else BLOCKS[0]


def _greatest(values: NDArray[np.float64]) -> float:
    defined = values[np.isfinite(values)]
    return float(defined.max()) if len(defined) else math.nan


def _strongest(gates: NDArray[np.int64]) -> int:
    """Safety before task before another rule before none."""
    return next((gate for gate in LETTERS if (gates == gate).any()), GATE_NONE)


def _line(name: str, marks: list[tuple[str, str]]) -> Text:
    """Marks of one style in a row are one piece: a terminal gets a third of the bytes."""
    line = Text(_label(name))
    for style, group in groupby(marks, key=lambda mark: mark[1]):
        line.append("".join(character for character, _ in group), style)
    return line


def _label(name: str) -> str:
    return "  " + name.ljust(LABEL - 2)
