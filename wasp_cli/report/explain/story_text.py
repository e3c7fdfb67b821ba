"""An episode in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from wasp_cli.metrics.episode import GATE_NONE
from wasp_cli.report.explain.facts import Run, Story, Who
from wasp_cli.report.explain.strip import strip_lines
from wasp_cli.report.explain.tell import merged
from wasp_cli.report.explain.words import (
    INDENT,
    STYLES,
    action,
    between,
    count,
    decider,
    entry,
    expected_cost,
    ms,
    not_in_file,
    places,
    plain,
    rule,
    short,
    signal_of,
    span,
    title,
    whose,
    wrapped,
)

MOST_RUNS = 24
"""Lines of the timeline at most, so that an episode stays below 60 lines."""


@dataclass(frozen=True)
class Column:
    """A column of the timeline."""

    title: str
    cells: tuple[str, ...]
    """a run each; `-` where there is nothing to say"""
    left: bool = False
    """words stand at the left, numbers at the right"""
    rank: int = 0
    """The highest goes first where there is no room; 0 stays."""
    always: bool = False
    """also where no run has anything to say"""

    @property
    def size(self) -> int:
        """Characters."""
        return max(len(self.title), *map(len, self.cells))

    def place(self, text: str) -> str:
        """A text in its column."""
        return text.ljust(self.size) if self.left else text.rjust(self.size)


def story_lines(story: Story, width: int, command: str = "wasp explain CELL") -> list[Text]:
    """An episode, in lines of at most `width` columns where words allow it.

    Args:
        story: the facts.
        width: columns.
        command: what explains this cell, for the hint at the end.
    """
    who, totals = story.who, story.totals
    lines = [title(f"{who.label} · episode {who.episode}", f"of 0 to {who.episodes - 1}")]
    lines += whose(who, width)
    lines += entry("rule", rule(who), width) if not story.gated else _thresholds(story, width)
    lines += entry("outcome", _outcome(story), width)
    lines += entry("interventions", _interventions(story), width)
    if story.gated or story.selective:
        lines += entry("gates", _shares(story), width)
    lines += entry("costs", _costs(story), width)
    lines += entry("decision time", _times(story), width)
    lines += not_in_file(story.unknown, who, width)
    strip = strip_lines(story, width)
    if strip:
        lines += [Text(), title("Over the episode"), *strip]
    pieces = merged(story.runs, MOST_RUNS)
    lines += [Text(), title("Run by run"), *_timeline(story, pieces, width)]
    lines += [Text(line, "dim") for line in wrapped(_legend(story, pieces), width, INDENT)]
    telling = (totals.missed, totals.intervened, totals.costly) if story.selective else (totals.costly, totals.intervened)
    place = next((decisions[0] for decisions in telling if decisions), 0)
    lines.append(Text(f"{' ' * INDENT}one decision in full: {command} --episode {who.episode} --step {place}", "dim"))
    return lines


def _thresholds(story: Story, width: int) -> list[Text]:
    """Both gates, with the thresholds in force."""
    thresholds, variant = story.thresholds, story.who.assistant_variant
    tau_c = f"fires where {expected_cost('more than ' + short(thresholds.tau_c), story.constants)} "
    tau_c += "if the operator goes on alone (G^c > τ_c, Eq. 9)"
    tau_r = "asked where the safety gate is silent; fires where a small correction is expected to gain more return than "
    tau_r += f"{short(thresholds.tau_r)} (ΔG > τ_r, Eq. 12)"
    off = "switched off in this variant"
    lines = entry("safety gate", off if variant == "task-only" else tau_c, width)
    return lines + entry("task gate", off if variant == "safety-only" else tau_r, width)


def _outcome(story: Story) -> str:
    totals, constants = story.totals, story.constants
    success = "success" if totals.success else "no success"
    text = f"return {plain(totals.return_)}, cost {count(totals.cost, 'env step')}, {count(totals.goals, 'goal')} ({success})"
    text += f" in {count(story.who.decisions, 'decision')}"
    if constants.action_repeat is not None:
        text += f" of {count(constants.action_repeat, 'env step')}"
    return text if constants.decision_seconds is None else f"{text} ({constants.decision_seconds:g} s)"


def _interventions(story: Story) -> str:
    totals = story.totals
    if not totals.intervened:
        return "none: every command was executed as it was"
    size = "" if totals.mag_int is None else f", by {totals.mag_int:.2f} on average (|a - a^H|)"
    return f"{len(totals.intervened)} of {count(story.who.decisions, 'decision')} changed ({totals.int_rate:.1%}, Int.){size}"


def _shares(story: Story) -> str:
    names = {"safety": "safety gate", "task": "task gate", "method": decider(story.who.method)}
    shares = [f"{names[gate]} {share:.1%}" for gate, share in story.totals.gate_share.items() if gate != "none"]
    shares.append(f"silent {story.totals.gate_share.get('none', 0.0):.1%}")
    text = ", ".join(shares) + " of decisions"
    fired = story.series["gate"] != GATE_NONE
    stood = int(fired.sum()) - sum(bool(fired[t]) for t in story.totals.intervened)
    if story.selective and stood:
        text += f"; at {stood} of the {int(fired.sum())} where one fired, the command stood all the same"
    if story.totals.case2 is not None:
        text += f"; while planning, {story.totals.case2:.0%} of the search steps found too few safe candidates (Case II)"
    return text


def _costs(story: Story) -> str:
    costly, missed = len(story.totals.costly), len(story.totals.missed)
    if not costly:
        return "none"
    text = f"{count(costly, 'decision')} with cost"
    if story.selective:
        text += f": {missed} while every gate was silent (missed), {costly - missed} although one had fired"
    return text


def _times(story: Story) -> str:
    totals, many = story.totals, story.who.episodes
    if totals.decision_p50_ms is None or totals.decision_p95_ms is None:
        return "not recorded"
    text = f"half of the decisions within {ms(totals.decision_p50_ms)} (p50), 95 % within {ms(totals.decision_p95_ms)} (p95)"
    return text if many == 1 else f"{text}; each is the time of all {many} episodes, decided side by side, divided by {many}"


def _timeline(story: Story, pieces: Sequence[Run], width: int) -> list[Text]:
    """A line per run. Columns that do not fit are left out, the least important first."""
    tau_c, tau_r = story.thresholds.tau_c, story.thresholds.tau_r
    columns = [
        Column("decisions", tuple(span(run.first, run.last) for run in pieces), left=True, always=True),
        Column("gate", tuple(_gate(run, story.who) for run in pieces), left=True, always=story.gated),
        Column("changed", tuple(_changed(run) for run in pieces), rank=1),
        Column("command → executed (means)", tuple(_change(run) for run in pieces), left=True, rank=2),
        Column(f"G^c (τ_c {short(tau_c)})", tuple(between(run.g_cost, tau_c) for run in pieces)),
        Column(f"ΔG (τ_r {short(tau_r)})", tuple(between(run.delta_g, tau_r) for run in pieces), rank=4),
        Column(signal_of(story.who.method).name, tuple(between(run.signal, None) for run in pieces), rank=3),
        Column("cost", tuple(str(run.cost) if run.cost else "-" for run in pieces)),
        Column("missed at", tuple(places(run.missed) for run in pieces), left=True),
    ]
    columns = [column for column in columns if column.always or set(column.cells) != {"-"}]
    if not story.selective:
        columns = [column for column in columns if column.title != "gate"]
    for column in sorted(columns, key=lambda column: -column.rank):
        if column.rank and INDENT + sum(column.size + 2 for column in columns) - 2 > width:
            columns.remove(column)

    def line(texts: Sequence[str]) -> str:
        return (" " * INDENT + "  ".join(column.place(text) for column, text in zip(columns, texts, strict=True))).rstrip()

    lines = [Text(line([column.title for column in columns]), "bold")]
    for i, run in enumerate(pieces):
        text = Text(line([column.cells[i] for column in columns]), STYLES[run.gate])
        if run.missed:  # the last column
            text.stylize("bold red", len(text) - len(places(run.missed)))
        lines.append(text)
    return lines


def _gate(run: Run, who: Who) -> str:
    """`safety`, or of merged runs `safety 12/15`."""
    name = {"none": "-", "method": decider(who.method)}.get(run.gate, run.gate)
    return name if len(run.gates) == 1 else f"{name} {run.gates[run.gate]}/{run.decisions}"


def _changed(run: Run) -> str:
    if not run.intervened:
        return "-"
    return f"{run.intervened} of {run.decisions}, by {plain(run.deviation * run.decisions / run.intervened)}"


def _change(run: Run) -> str:
    command = action(run.command)
    return f"{command} → {action(run.executed)}" if run.intervened else f"{command} as commanded"


def _legend(story: Story, pieces: Sequence[Run]) -> str:
    parts = ["changed: decisions whose command was not executed as it was, and by how much (|a - a^H|)"] if story.totals.intervened else []
    parts += ["cost: env steps with cost"] if story.totals.costly else []
    if story.totals.missed:
        parts.append("missed: cost was paid and no gate had fired")
    if len(pieces) < len(story.runs):
        parts.append(f"{len(story.runs)} runs in {len(pieces)} lines, short ones merged: 'safety 12/15' is 12 of 15 decisions")
    if len(story.totals.gate_share) == 1 and len(story.runs) > 1:
        why = "the gate never changed, so " if story.selective else ""
        parts.append(f"{why}the lines are stretches with and without cost")
    return "; ".join(parts)
