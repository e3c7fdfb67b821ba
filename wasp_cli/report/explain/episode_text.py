"""An episode as tables: outcome, gates, a strip of characters over time, and its runs of decisions under one gate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from wasp_cli.metrics.episode import GATE_LATE, GATE_METHOD, GATE_NONE, GATE_SAFETY, GATE_TASK
from wasp_cli.report.explain.facts import Run, exceeds, merged_runs, places_of, runs_of
from wasp_cli.report.explain.layout import (
    BETWEEN,
    INDENT,
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
    section,
    set_out,
    short,
    span,
    table,
)
from wasp_cli.report.explain.stored import Episode, number
from wasp_cli.report.explain.timeline import LOOKS

MOST_RUNS = 24  # rows of the table of runs at most, so that an episode stays below 60 lines

BLOCKS = "▁▂▃▄▅▆▇█"
LABEL = 12  # columns before the strip
STYLES = {"none": "dim"} | {look.kind: look.style for look in LOOKS.values()}


def episode_lines(episode: Episode, width: int, command: str = "wasp explain CELL") -> list[Text]:
    """Set out an episode, in lines of at most `width` columns; the last line says how `command` explains one decision."""
    telling = (episode.missed, episode.intervened, episode.costly) if episode.selective else (episode.costly, episode.intervened)
    place = next((int(marks.argmax()) for marks in telling if marks.any()), 0)
    hint = f"{' ' * INDENT}one decision in full: {command} --episode {episode.row['episode']} --step {place}"
    return [*set_out(_parts(episode, width), width), Text(hint, "dim")]


def _parts(episode: Episode, width: int) -> Iterator[RenderableType]:
    yield heading(f"{episode.label} · episode {episode.row['episode']}", f"of 0 to {episode.episodes - 1}")
    yield _headline(episode)
    yield ""
    yield fields([*cell_fields(episode), *_outcome(episode)])
    if episode.selective:
        yield from section("Gates" if episode.gated else "Decisions", *_gates(episode))
    if strip := strip_lines(episode, width):
        yield from section("Over the episode", *strip)
    runs = merged_runs(episode, MOST_RUNS)
    yield from section("Runs of decisions", _runs(episode, runs, width), *notes(_legend(episode, runs)))


def _headline(episode: Episode) -> str:
    intervened, costly, missed, late = _counts(episode)
    changed = f"{intervened} of {count(episode.decisions, 'command')} changed" if intervened else "No command changed"
    blame = f", {missed} of them missed (no gate fired)" if costly and episode.selective else ""
    blame += f", {late} while the assistant was late" if late else ""
    return f"{changed}; {count(costly, 'decision') if costly else 'no decision'} with cost{blame}."


def _counts(episode: Episode) -> tuple[int, int, int, int]:
    """How many decisions were changed, had cost, had cost without a gate, had cost while the assistant was late."""
    return int(episode.intervened.sum()), int(episode.costly.sum()), int(episode.missed.sum()), int(episode.late.sum())


def _outcome(episode: Episode) -> Iterator[tuple[str, str]]:
    row, constants, many = episode.row, episode.constants, episode.episodes
    intervened, costly, missed, late = _counts(episode)
    outcome = f"return {plain(row['return'])}, {count(row['goals'], 'goal')} ({'success' if row['success'] else 'no success'})"
    outcome += f", {count(episode.decisions, 'decision')}"
    if constants.action_repeat is not None:
        outcome += f" of {count(constants.action_repeat, 'env step')}"
    if constants.decision_seconds is not None:
        outcome += f" ({constants.decision_seconds:g} s)"
    yield "outcome", outcome
    cost = count(row["cost"], "env step")
    if costly:
        cost += f", in {count(costly, 'decision')}"
        cost += f": {missed} missed, {costly - missed - late} although a gate fired" if episode.selective else ""
        cost += f", {late} while the assistant was late" if late else ""
    yield "cost", cost
    mean, case2, p50, p95 = (number(row[name]) for name in ("mag_int", "case2", "decision_p50_ms", "decision_p95_ms"))
    size = "" if mean is None else f", by {mean:.2f} on average (|a - a^H|)"
    yield "changed", f"{count(intervened, 'decision')} ({row['int_rate']:.1%}, Int.){size}" if intervened else "none"
    if case2 is not None:
        yield "Case II", f"{case2:.0%} of the planner's iterations: too few safe candidates"
    if p50 is None or p95 is None:
        yield "time", "not recorded"
    else:
        shared = "" if many == 1 else f"; the time of all {many} episodes, decided side by side, divided by {many}"
        yield "time", f"{ms(p50)} per decision (p50), {ms(p95)} (p95){shared}"


def _gates(episode: Episode) -> Iterator[RenderableType]:
    """How often each gate fired, and above which value it does."""
    thresholds, signal, off = episode.thresholds, episode.signal, "off in this variant"
    late = bool((episode.gate == GATE_LATE).any())
    above = "-" if episode.gated or episode.signal_limit is None else f"{signal.name} > {short(episode.signal_limit)}"
    gates = [(GATE_METHOD, decider(episode.method), above)]
    if episode.gated:
        safety = off if episode.variant == "task-only" else f"G^c > τ_c {short(thresholds.tau_c)}"
        task = off if episode.variant == "safety-only" else f"ΔG > τ_r {short(thresholds.tau_r)}"
        own = gates if (episode.gate == GATE_METHOD).any() else []
        gates = [(GATE_SAFETY, "safety", safety), (GATE_TASK, "task", task), *own]
    rows = []
    for gate, name, where in [*gates, (GATE_NONE, "none", "-"), *([(GATE_LATE, "late", "no answer in time")] if late else [])]:
        fired = episode.gate == gate
        stood = int((fired & ~episode.intervened).sum()) if gate not in (GATE_NONE, GATE_LATE) else 0
        rows.append([name, where, str(int(fired.sum())), f"{fired.mean():.1%}", str(stood) if stood else "-"])
    yield table(["gate", "fires where", "decisions", "share", "command kept"], rows)
    if episode.gated:
        yield from notes(cost_meaning(episode.constants), gain_meaning(episode.constants))
    else:
        yield from notes(f"{signal.name}: {signal.meaning}")
    if any(row[-1] != "-" for row in rows):
        yield from notes("command kept: a gate fired, and the command was executed as it was")
    if late:
        yield from notes("late: the assistant had not answered in time, no gate was asked, and the command was executed as it was")


def _runs(episode: Episode, runs: Sequence[Run], width: int) -> RenderableType:
    tau_c, tau_r = episode.thresholds.tau_c, episode.thresholds.tau_r
    columns = [
        ("decisions", [span(run.first, run.last) for run in runs]),
        ("gate", [_gate(run, episode.method) if episode.selective else "-" for run in runs]),
        ("changed", [_changed(run) for run in runs]),
        ("command → executed (means)", [_change(run) for run in runs]),
        (f"G^c (τ_c {short(tau_c)})", [between(run.g_cost, tau_c) for run in runs]),
        (f"ΔG (τ_r {short(tau_r)})", [between(run.delta_g, tau_r) for run in runs]),
        (episode.signal.name, [between(run.signal, None) for run in runs]),
        ("cost", [str(run.cost) if run.cost else "-" for run in runs]),
        ("missed at", [places(run.missed) for run in runs]),
    ]
    # Where there is no room, what says least goes.
    for place in (5, 6, 3, 2):
        sizes = [max(map(len, (title, *cells))) for title, cells in columns if set(cells) != {"-"}]
        if INDENT + sum(sizes) + BETWEEN * (len(sizes) - 1) > width:
            columns[place] = (columns[place][0], ["-"] * len(runs))
    rows: list[list[str | Text]] = [list(row) for row in zip(*(cells for _, cells in columns), strict=True)]
    for row, run in zip(rows, runs, strict=True):
        row[-1] = Text(places(run.missed), "bold red" if run.missed else "")
    return table([title for title, _ in columns], rows, [STYLES[run.gate] for run in runs])


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


def _legend(episode: Episode, runs: Sequence[Run]) -> str:
    parts = []
    if episode.intervened.any():
        parts.append("changed: decisions with another action than the command, and by how much (|a - a^H|)")
    if episode.costly.any():
        parts.append("cost: env steps with cost")
    if episode.missed.any():
        parts.append("missed: cost, and no gate fired")
    all_runs = len(runs_of(episode))
    if len(runs) < all_runs:
        parts.append(f"{all_runs} runs in {len(runs)} rows, short ones merged: 'safety 12/15' is 12 of 15 decisions")
    if len(set(episode.gate.tolist())) == 1 and all_runs > 1:
        why = "the gate never changed, so " if episode.selective else ""
        parts.append(f"{why}the rows are stretches with and without cost")
    return "; ".join(parts)


def strip_lines(episode: Episode, width: int) -> list[RenderableType]:
    """Draw the safety gate's value over time, the gates below it and the costs below them.

    Returns none where there is nothing to draw (no gate's value, no intervention).
    """
    values, name = episode.numbers["deviation"], "|a - a^H|"
    limit: float | None = None
    if episode.gated and np.isfinite(episode.numbers["g_cost"]).any():
        values, name, limit = episode.numbers["g_cost"], "G^c", episode.thresholds.tau_c
    # Half of the height is the threshold: what stands above the middle has fired, without any colour.
    full = 2 * float(np.float32(limit)) if limit is not None and limit > 0 else float(np.nanmax(values))
    if not full:
        return []
    per = max(1, math.ceil(len(values) / max(20, width - LABEL - 2)))
    missed = set(places_of(episode.missed))
    curve, gates, costs = (_line(title) for title in (name, "gate", "cost"))
    for first in range(0, len(values), per):
        part = slice(first, first + per)
        height = float(np.fmax.reduce(values[part]))
        curve.append(_block(height, full), "" if limit is None else "red" if exceeds(height, limit) else "green")
        look = next((look for gate, look in LOOKS.items() if (episode.gate[part] == gate).any()), None)
        gates.append(look.letter if look else "·", look.style if look else "dim")
        paid = [first + t for t in places_of(episode.costly[part])]
        costs.append(("!" if missed.intersection(paid) else "x") if paid else "·", "bold red" if paid else "dim")
    fired = [look for gate, look in LOOKS.items() if (episode.gate == gate).any() and episode.selective]
    columns, last = len(curve) - LABEL, str(len(values) - 1)
    axis = _line("decision").append("0" + last.rjust(max(columns - 1, len(last) + 1)))
    scale = [f"█ is {full:.3g}" if limit is None else f"▁▂▃▄ up to τ_c = {limit:.3g}, ▅▆▇█ above it"]
    scale += [f"{look.letter} {look.words}" for look in fired]
    if episode.costly.any():
        scale.append("x cost, ! cost that every gate missed" if missed else "x cost")
    if per > 1:
        scale.append(f"a column is the maximum of {per} decisions")
    return [curve, *([gates] if fired else []), *([costs] if episode.costly.any() else []), axis, *notes("; ".join(scale))]


def _line(name: str) -> Text:
    return Text(" " * INDENT + name.ljust(LABEL - INDENT), no_wrap=True, overflow="ignore")


def _block(height: float, full: float) -> str:
    """A value up to half of `full` is in the lower four blocks, the half itself too."""
    if math.isnan(height):
        return " "
    return BLOCKS[min(max(math.ceil(8 * height / full) - 1, 0), 7)] if full > 0 else BLOCKS[0]
