"""An episode and a decision as tables, in plain words with the paper's symbols.

An episode: outcome, gates, and its runs of decisions under one gate. A decision: the action, the
gates, the plan, and what then happened.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from rich.console import RenderableType
from rich.text import Text

from wasp_cli.methods.registry import METHODS
from wasp_cli.metrics.episode import (
    CUT_OFF,
    GATE_LATE,
    GATE_METHOD,
    GATE_NONE,
    GATE_SAFETY,
    GATE_TASK,
)
from wasp_cli.operators.registry import OPERATORS, UNIMPAIRED
from wasp_cli.report.explain.episode import Constants, Episode, number
from wasp_cli.report.explain.facts import (
    Decision,
    Planned,
    Run,
    decision_of,
    exceeds,
    merged_runs,
    runs_of,
)
from wasp_cli.report.explain.layout import (
    BETWEEN,
    INDENT,
    action,
    beside,
    between,
    count,
    fields,
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
from wasp_cli.report.explain.timeline import LOOKS
from wasp_cli.report.tables import who_title
from wasp_cli.store.plain import printable
from wasp_cli.store.severities import is_auto
from wasp_cli.tasks.registry import TASKS

MOST_RUNS = 24  # rows of the table of runs at most, so that an episode stays below 60 lines

STYLES = {"none": "dim"} | {look.kind: look.style for look in LOOKS.values()}


def episode_lines(episode: Episode, width: int, command: str = "wasp explain CELL") -> list[Text]:
    """Return what is to say of an episode, in lines that are at most `width` wide."""
    telling = (
        (episode.missed, episode.intervened, episode.costly)
        if episode.selective
        else (episode.costly, episode.intervened)
    )
    place = next((int(marks.argmax()) for marks in telling if marks.any()), 0)
    hint = (
        f"{' ' * INDENT}one decision in full: {command} --episode {episode.row['episode']} "
        f"--step {place}"
    )
    intervened, costly, missed, late = _counts(episode)
    changed = (
        f"{intervened} of {count(episode.decisions, 'command')} changed"
        if intervened
        else "No command changed"
    )
    blame = f", {missed} of them missed (no gate fired)" if costly and episode.selective else ""
    blame += f", {late} while the assistant was late" if late else ""
    runs = merged_runs(episode, MOST_RUNS)
    parts = [
        heading(
            f"{episode.label} · episode {episode.row['episode']}", f"of 0 to {episode.episodes - 1}"
        ),
        f"{changed}; {count(costly, 'decision') if costly else 'no decision'} with cost{blame}.",
        "",
        fields([*_cell(episode), *_outcome(episode)]),
        *(
            section("Gates" if episode.gated else "Decisions", *_gate_counts(episode))
            if episode.selective
            else ()
        ),
        *section("Runs of decisions", _runs(episode, runs, width), *notes(_legend(episode, runs))),
    ]
    return [*set_out(parts, width), Text(hint, "dim")]


def _cell(episode: Episode) -> list[tuple[str, str]]:
    row = episode.row
    method = episode.method
    task = TASKS[row["task"]].title if row["task"] in TASKS else row["task"]
    rule = METHODS[method].rule if method in METHODS else ""
    operator = row["operator"]
    severity = "" if row["value"] is None else f" {row['value']:g}"
    if operator in OPERATORS:
        operator, severity = (
            OPERATORS[operator].title.lower(),
            f"{severity} ({OPERATORS[operator].unit})",
        )
    if is_auto(episode.cell.manifest):
        severity += ", chosen on held-out worlds"
    return [
        (
            "cell",
            f"{task}, {who_title(method, episode.variant)}, seed {row['seed']}, world "
            f"{row['episode_seed']}",
        ),
        ("operator", "unimpaired" if row["operator"] == UNIMPAIRED else operator + severity),
        ("method", rule or f"not described: see the documentation of '{method}'"),
        *_operating_point(episode),
        ("key", episode.cell.key or f"none; read from {episode.cell.path}"),
    ]


def _operating_point(episode: Episode) -> Iterator[tuple[str, str]]:
    """What was chosen for the assistant on held-out worlds, where anything was."""
    point = episode.cell.setting("summary", "operating_point")
    if isinstance(point, str):
        why = ": no setting helped on held-out worlds, so that every command stands"
        yield "operating point", printable(point) + (why if point == "silent" else "")


def _cost_meaning(constants: Constants) -> str:
    if constants.bootstrap_cost:
        return (
            f"G^c: expected discounted cost if {_goes_on(constants)}, with the critic beyond "
            "the horizon (Eq. 9)"
        )
    within = (
        "the horizon H"
        if constants.horizon is None
        else f"the next {count(constants.horizon, 'decision')}"
    )
    return (
        f"G^c: expected costly decisions within {within}, discounted, if {_goes_on(constants)} "
        "(Eq. 9)"
    )


def _goes_on(constants: Constants) -> str:
    if not constants.takeover:
        return "the operator goes on alone"
    return "the expert follows" if constants.vote is None else "the expert follows IDA's action"


def _gain_meaning(constants: Constants) -> str:
    if constants.takeover:
        return (
            "ΔG: expected gain in return by the expert's action now, where the safety gate is "
            "silent (Eq. 12)"
        )
    tried = "" if constants.probe is None else f" of {constants.probe} that are tried"
    return (
        f"ΔG: expected gain in return by the best safe correction{tried}, where the safety "
        "gate is silent (Eq. 12)"
    )


def _counts(episode: Episode) -> tuple[int, int, int, int]:
    return (
        int(episode.intervened.sum()),
        int(episode.costly.sum()),
        int(episode.missed.sum()),
        int(episode.late.sum()),
    )


def _outcome(episode: Episode) -> Iterator[tuple[str, str]]:
    row = episode.row
    constants = episode.constants
    many = episode.side_by_side
    intervened, costly, missed, late = _counts(episode)
    outcome = (
        f"return {plain(row['return'])}, {count(row['goals'], 'goal')} "
        f"({'success' if row['success'] else 'no success'})"
    )
    outcome += f", {count(episode.decisions, 'decision')}"
    if constants.action_repeat is not None:
        outcome += f" of {count(constants.action_repeat, 'env step')}"
    if constants.decision_seconds is not None:
        outcome += f" ({constants.decision_seconds:g} s)"
    yield "outcome", outcome
    cost = count(row["cost"], "env step")
    if costly:
        cost += f", in {count(costly, 'decision')}"
        cost += (
            f": {missed} missed, {costly - missed - late} although a gate fired"
            if episode.selective
            else ""
        )
        cost += f", {late} while the assistant was late" if late else ""
    yield "cost", cost
    mean, case2, p50, p95 = (
        number(row[name]) for name in ("mag_int", "case2", "decision_p50_ms", "decision_p95_ms")
    )
    size = "" if mean is None else f", by {mean:.2f} on average (|a - a^H|)"
    yield (
        "changed",
        f"{count(intervened, 'decision')} ({row['int_rate']:.1%}, Int.){size}"
        if intervened
        else "none",
    )
    if case2 is not None:
        yield "Case II", f"{case2:.0%} of the planner's iterations: too few safe candidates"
    if p50 is None or p95 is None:
        yield "time", "not recorded"
    else:
        shared = (
            ""
            if many == 1
            else f"; the time of {many} episodes decided side by side, divided by {many}"
        )
        yield "time", f"{ms(p50)} per decision (p50), {ms(p95)} (p95){shared}"


def _gate_counts(episode: Episode) -> Iterator[RenderableType]:
    thresholds = episode.thresholds
    signal = episode.signal
    off = FIRES["off"]
    late = bool((episode.gate == GATE_LATE).any())
    above = (
        "-" if episode.signal_limit is None else f"{signal.name} > {short(episode.signal_limit)}"
    )
    gates = [(GATE_METHOD, who_title(episode.method), above)]
    if episode.gated:
        safety = off if episode.variant == "task-only" else f"G^c > τ_c {short(thresholds.tau_c)}"
        task = f"ΔG > τ_r {short(thresholds.tau_r)}" if episode.asks_task else off
        own = gates if (episode.gate == GATE_METHOD).any() else []
        gates = [(GATE_SAFETY, "safety", safety), (GATE_TASK, "task", task), *own]
    rows = []
    for gate, name, where in [
        *gates,
        (GATE_NONE, "none", "-"),
        *([(GATE_LATE, "late", "no answer in time")] if late else []),
    ]:
        fired = episode.gate == gate
        stood = (
            int((fired & ~episode.intervened).sum()) if gate not in (GATE_NONE, GATE_LATE) else 0
        )
        rows.append(
            [
                name,
                where,
                str(int(fired.sum())),
                f"{fired.mean():.1%}",
                str(stood) if stood else "-",
            ]
        )
    yield table(["gate", "fires where", "decisions", "share", "command kept"], rows)
    if episode.gated:
        yield from notes(_cost_meaning(episode.constants), _gain_meaning(episode.constants))
    else:
        yield from notes(f"{signal.name}: {signal.meaning}")
    if any(row[-1] != "-" for row in rows):
        yield from notes("command kept: a gate fired, and the command was executed as it was")
    if late:
        yield from notes(
            "late: the assistant had not answered in time, no gate was asked, and the "
            "command was executed as it was"
        )


def _runs(episode: Episode, runs: Sequence[Run], width: int) -> RenderableType:
    tau_c = episode.thresholds.tau_c
    tau_r = episode.thresholds.tau_r
    columns = [
        _Column("decisions", [span(run.first, run.last) for run in runs]),
        _Column("gate", [_gate_of(episode, run) for run in runs]),
        _Column("changed", [_change_of(run) for run in runs], dropped=4),
        _Column("command → executed (means)", [_actions_of(run) for run in runs], dropped=3),
        _Column(f"G^c (τ_c {short(tau_c)})", [between(run.g_cost, tau_c) for run in runs]),
        _Column(
            f"ΔG (τ_r {short(tau_r)})", [between(run.delta_g, tau_r) for run in runs], dropped=1
        ),
        _Column(episode.signal.name, [between(run.signal, None) for run in runs], dropped=2),
        _Column("cost", [str(run.cost) if run.cost else "-" for run in runs]),
        _Column("missed at", [places(run.missed) for run in runs]),
    ]
    columns = _fitting(columns, width)
    rows: list[list[str | Text]] = [
        list(row) for row in zip(*(column.cells for column in columns), strict=True)
    ]
    for row, run in zip(rows, runs, strict=True):
        row[-1] = Text(places(run.missed), "bold red" if run.missed else "")
    return table([column.title for column in columns], rows, [STYLES[run.gate] for run in runs])


@dataclass(frozen=True)
class _Column:
    """A column of the runs of an episode."""

    title: str
    cells: list[str]
    dropped: int | None = None
    """Its turn to go where there is no room, from 1; None: it always stays."""

    @property
    def is_empty(self) -> bool:
        """Whether no cell says anything."""
        return set(self.cells) == {"-"}

    @property
    def width(self) -> int:
        """Characters of the longest cell."""
        return max(map(len, (self.title, *self.cells)))


def _fitting(columns: list[_Column], width: int) -> list[_Column]:
    """Empty the columns that say least until the others fit; a table leaves empty ones out."""
    kept = list(columns)
    turns = [place for place, column in enumerate(columns) if column.dropped is not None]
    for place in sorted(turns, key=lambda place: columns[place].dropped or 0):
        widths = [column.width for column in kept if not column.is_empty]
        if INDENT + sum(widths) + BETWEEN * (len(widths) - 1) > width:
            kept[place] = replace(kept[place], cells=["-"] * len(kept[place].cells))
    return kept


def _gate_of(episode: Episode, run: Run) -> str:
    """The gate of a run; of merged runs with how many decisions have it: `safety 12/15`."""
    if not episode.selective or run.gate == "none":
        name = "-"
    elif run.gate == "method":
        name = who_title(episode.method)
    else:
        name = run.gate
    if not episode.selective or len(run.gates) == 1:
        return name
    return f"{name} {run.gates[run.gate]}/{run.decisions}"


def _change_of(run: Run) -> str:
    """In how many decisions of a run the command was changed, and by how much on average."""
    if not run.intervened:
        return "-"
    by = plain(run.deviation * run.decisions / run.intervened)
    return f"{run.intervened} of {run.decisions}, by {by}"


def _actions_of(run: Run) -> str:
    """The mean command of a run, and the mean action if any was changed."""
    executed = f"→ {action(run.executed)}" if run.intervened else "as commanded"
    return f"{action(run.command)} {executed}"


def _legend(episode: Episode, runs: Sequence[Run]) -> str:
    parts = []
    if episode.intervened.any():
        parts.append(
            "changed: decisions with another action than the command, and by how much (|a - a^H|)"
        )
    if episode.costly.any():
        parts.append("cost: env steps with cost")
    if episode.missed.any():
        parts.append("missed: cost, and no gate fired")
    all_runs = len(runs_of(episode))
    if len(runs) < all_runs:
        parts.append(
            f"{all_runs} runs in {len(runs)} rows, short ones merged: 'safety 12/15' is 12 "
            "of 15 decisions"
        )
    if len(set(episode.gate.tolist())) == 1 and all_runs > 1:
        why = "the gate never changed, so " if episode.selective else ""
        parts.append(f"{why}the rows are stretches with and without cost")
    return "; ".join(parts)


FIRES = {
    "fired": "yes",
    "silent": "no",
    "not asked": "not asked: the safety gate fired",
    "no candidate": "no: no correction is predicted safe (Eq. 11)",
    "withheld": "no: the correction is not predicted safe, or changes no force",
    "late": "not asked: the assistant was late",
    "off": "this assistant has no such gate",
    "unknown": "not recorded",
}


def decision_lines(episode: Episode, t: int, width: int) -> list[Text]:
    """Return what is to say of one decision, in lines that are at most `width` wide."""
    return set_out(_decision_parts(episode, decision_of(episode, t)), width)


def _decision_parts(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    yield heading(
        f"{episode.label} · episode {episode.row['episode']} · decision {facts.t}",
        f"of 0 to {episode.decisions - 1}",
    )
    yield _decision_headline(episode, facts)
    yield ""
    yield fields(_cell(episode))
    yield from section("Action", _action(facts))
    if facts.safety is not None and facts.task is not None:
        rows = []
        styles = []
        for look, gate, symbol, limit in (
            (LOOKS[GATE_SAFETY], facts.safety, "G^c", "τ_c"),
            (LOOKS[GATE_TASK], facts.task, "ΔG", "τ_r"),
        ):
            value, threshold = beside(gate.value, gate.threshold)
            rows.append([look.kind, f"{symbol} {value}", f"{limit} {threshold}", FIRES[gate.state]])
            styles.append(look.style if gate.state == "fired" else "")
        meanings = notes(_cost_meaning(episode.constants), _gain_meaning(episode.constants))
        yield from section(
            "Gates", table(["gate", "value", "threshold", "fires"], rows, styles), *meanings
        )
        yield from section("Plan", *_plan(episode, facts))
    if facts.signal is not None:
        signal = episode.signal
        needed = episode.signal_limit
        # a gate behind a vote
        fired = facts.gate == "method" or (facts.gate == "safety" and exceeds(facts.signal, needed))
        row = [
            signal.name,
            *beside(facts.signal, needed),
            short(episode.thresholds.tau_q),
            "yes" if fired else "no",
        ]
        drawn = table(
            ["signal", "value", "threshold", "τ_Q", "intervenes"],
            [row],
            [LOOKS[GATE_METHOD].style if fired else ""],
        )
        yield from section("Decision", drawn, *notes(f"{signal.name}: {signal.meaning}"))
    shared = episode.side_by_side
    time = "not recorded" if facts.ms is None else ms(facts.ms)
    if facts.ms is not None and shared > 1:
        time += (
            f": the time of {shared} episodes decided side by side, {ms(facts.ms * shared)}, "
            f"divided by {shared}"
        )
    yield from section(
        "What then happened", *_happened(episode, facts), fields([("decision time", time)])
    )


def _decision_headline(episode: Episode, facts: Decision) -> str:
    did = (
        f"the command was changed by {facts.deviation:.3g}"
        if facts.intervened
        else "the command was executed"
    )
    for name, gate, symbols in (
        ("safety", facts.safety, ("G^c", "τ_c")),
        ("task", facts.task, ("ΔG", "τ_r")),
    ):
        if gate is not None and gate.state == "fired":
            value, limit = beside(gate.value, gate.threshold)
            if facts.plan is not None and not facts.intervened:
                did = "the best correction was none, the command was executed"
            return f"The {name} gate fired ({symbols[0]} {value} > {symbols[1]} {limit}): {did}."
    if facts.gate == "late":
        return f"The assistant had not answered in time: {did}."
    if facts.gate == "method":
        return f"{who_title(episode.method)} intervened: {did}."
    return f"No gate fired: {did}." if facts.safety is not None else f"{did.capitalize()}."


def _action(facts: Decision) -> RenderableType:
    how = "the command"
    if facts.intervened and facts.plan is None:
        how = "the method's own action"
    elif facts.intervened and facts.plan is not None:
        wished = [
            command + residual
            for command, residual in zip(facts.command, facts.plan.residuals[0], strict=True)
        ]
        cut = ", cut off at the bounds" if any(abs(wish) > 1 + 1e-4 for wish in wished) else ""
        least = any(
            abs(min(max(wish, -1.0), 1.0) - done) > 1e-4
            for wish, done in zip(wished, facts.executed, strict=True)
        )
        how = (
            "command and first "
            f"correction{cut}{', as the least action of that force' if least else ''} (Eq. 18)"
        )
    rows = [
        ["command", action(facts.command), "a^H, from the operator"],
        ["executed", action(facts.executed), f"a, {how}"],
        [
            "deviation",
            f"{facts.deviation:.3g}",
            f"|a - a^H|, {'an' if facts.intervened else 'no'} intervention",
        ],
    ]
    return table(["action", "value", "meaning"], rows)


def _plan(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    plan = facts.plan
    if plan is None:
        why = {
            "late": "the assistant was late",
            "method": "the method decided by its own rule",
        }.get(facts.gate, "no gate fired")
        yield fields(
            [("search", "not recorded" if facts.gate in ("safety", "task") else f"none: {why}")]
        )
        return
    if plan.searched:
        cut = plan.safe.count(CUT_OFF)  # they stand before the iterations that were made
        made = zip(plan.safe[cut:], plan.case2[cut:], strict=True)
        rows = [
            [str(i), str(safe), "II" if case2 else "I"] for i, (safe, case2) in enumerate(made, 1)
        ]
        yield table(["iteration", "safe (|F_s|)", "case"], rows)
        yield from notes(*(_case(episode, case2) for case2 in sorted(set(plan.case2[cut:]))))
        yield from notes(
            f"the search was cut off before its last {count(cut, 'iteration')}: its time was up"
            if cut
            else ""
        )
    else:
        said = (
            "none: the correction that the gate compared with the command is predicted safe, "
            "and is carried out"
        )
        yield fields([("search", said)])
    yield from _corrections(episode, facts, plan)
    yield from _predicted(episode, facts, plan)


def _corrections(episode: Episode, facts: Decision, plan: Planned) -> list[RenderableType]:
    if plan.empty:
        why = "no candidate was predicted to be worth its size (Eq. 16-17)"
        if episode.variant == "no-case2" and not any(plan.safe):
            why = "no candidate was safe, and this variant has no recovery (Case II)"
        elif (
            facts.gate == "safety"
            and plan.alone_cost is not None
            and not exceeds(plan.alone_cost, episode.thresholds.tau_c)
        ):
            why = (
                "on a second look the command alone was predicted safe, and no correction was "
                "worth more"
            )
        return [fields([("correction", f"none: {why}")])]
    many = (
        len(plan.residuals)
        if plan.searched
        else max(k for k, residual in enumerate(plan.residuals) if any(residual)) + 1
    )
    rows = [
        [f"+{k}", action(residual), "not executed: planned again then"]
        for k, residual in enumerate(plan.residuals[:many])
    ]
    rows[0][::2] = "now", "executed"
    return ["", table(["step", "correction δa (Eq. 13)", "use"], rows)]


def _case(episode: Episode, case2: bool) -> str:
    feasible = episode.constants.feasible
    needed = "N_f" if feasible is None else f"N_f = {feasible}"
    if not case2:
        return (
            f"Case I: at least {needed} candidates are safe (Eq. 14); the search maximizes "
            "predicted return (Eq. 16)"
        )
    if episode.variant == "no-case2":
        return (
            f"Case II: fewer than {needed} are safe; this variant has no recovery and goes on "
            "with these"
        )
    return (
        f"Case II: fewer than {needed} are safe (Eq. 14); the search minimizes predicted cost "
        "(Eq. 17)"
    )


def _fired_on_an_error_that_goes_on(facts: Decision, plan: Planned, limit: float | None) -> bool:
    """Return whether the command alone was predicted safe, but not with the operator's error at
    the decisions behind it.
    """
    if facts.gate != "safety" or facts.safety is None:
        return False
    if plan.searched or plan.alone_cost is None:
        return False
    return exceeds(facts.safety.value, limit) and not exceeds(plan.alone_cost, limit)


def _predicted(episode: Episode, facts: Decision, plan: Planned) -> list[RenderableType]:
    limit = episode.thresholds.tau_c
    sequences = [
        (
            "command alone" if episode.constants.takeover else "commands alone",
            plan.alone_cost,
            plan.alone_return,
        )
    ]
    if not plan.empty:
        sequences.insert(0, ("with the correction", plan.cost, plan.return_))
    rows = []
    for name, cost, gain in sequences:
        value, bound = beside(cost, limit)
        if cost is None or limit is None:
            within = "-"
        elif exceeds(cost, limit):
            within = f"no, above {bound}"
        else:
            within = "yes"
        rows.append([name, value, within, short(gain)])
    # The printed WASP plans on the rollouts of its gates; a correction without a search is one of
    # the futures that they compared.
    again = facts.gate == "safety" and plan.searched and episode.method != "printed"
    drawn = table(["predicted", "cost (G^c)", f"within τ_c {short(limit)}", "return (G^r)"], rows)
    remarks = []
    if again:
        remarks.append("the gate used other rollouts, so its G^c may differ")
    if _fired_on_an_error_that_goes_on(facts, plan, limit):
        assert facts.safety is not None
        ahead = short(facts.safety.value)
        remarks.append(f"if the operator's error goes on, the command costs {ahead}")
    return ["", drawn, *notes(*remarks)]


def _happened(episode: Episode, facts: Decision) -> Iterator[RenderableType]:
    ahead = facts.ahead
    constants = episode.constants
    rows = [
        [
            span(part.first, part.last),
            str(part.intervened),
            plain(part.reward, sign=True),
            *map(str, (part.cost, part.costly, part.goals)),
        ]
        for part in (facts.now, ahead)
    ]
    yield table(["decisions", "changed", "reward", "cost", "costly decisions", "goals"], rows)
    ended = ahead.last - ahead.first + 1 < facts.window
    yield from notes(
        "cost: env steps with cost"
        + (f"; the episode ended before {facts.window} decisions" if ended else "")
    )
    # The gate's expectation beside what came, where both count the same.
    comparable = constants.horizon == facts.window and constants.bootstrap_cost is False
    if (
        facts.safety is not None
        and facts.safety.value is not None
        and ahead.discounted is not None
        and comparable
    ):
        came = f"observed{', with the interventions' if ahead.intervened else ''}"
        first = "the command" if constants.vote is None else "IDA's action"
        expected = f"{first}, then the expert" if constants.takeover else "the operator alone"
        rows = [
            [f"expected of {expected} (G^c)", short(facts.safety.value)],
            [came, short(ahead.discounted)],
        ]
        yield table(["costly decisions", f"discounted (γ_c {short(constants.gamma_c)})"], rows)
