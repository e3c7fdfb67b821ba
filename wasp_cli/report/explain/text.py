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
    """Return an episode as lines of at most `width` characters.

    Args:
        command: how to call `wasp explain` for this cell; the last line says how to see a decision.
    """
    number = episode.row["episode"]
    totals = _totals(episode)

    # One sentence: commands that were changed, and costs.
    changed = "No command changed"
    if totals.intervened:
        changed = f"{totals.intervened} of {count(episode.decisions, 'command')} changed"
    cost = "no decision with cost"
    if totals.costly:
        cost = f"{count(totals.costly, 'decision')} with cost"
        if episode.selective:
            cost += f", {totals.missed} of them missed (no gate fired)"
    if totals.late:
        cost += f", {totals.late} while the assistant was late"

    runs = merged_runs(episode, MOST_RUNS)
    parts: list[RenderableType] = [
        heading(f"{episode.label} · episode {number}", f"of 0 to {episode.episodes - 1}"),
        f"{changed}; {cost}.",
        "",
        fields([*_cell(episode), *_outcome(episode)]),
    ]
    if episode.selective:
        parts += section("Gates" if episode.gated else "Decisions", *_gate_counts(episode))
    table_of_runs = _runs(episode, runs, width)
    parts += section("Runs of decisions", table_of_runs, *notes(_legend(episode, runs)))
    hint = (
        f"{' ' * INDENT}one decision in full: {command} --episode {number} --step "
        f"{_telling_decision(episode)}"
    )
    return [*set_out(parts, width), Text(hint, "dim")]


def _telling_decision(episode: Episode) -> int:
    """The decision that a reader may want to see first: the first one that was missed, changed or
    costly.
    """
    marks = [episode.costly, episode.intervened]
    if episode.selective:
        marks = [episode.missed, episode.intervened, episode.costly]
    for each in marks:
        if each.any():
            return int(each.argmax())
    return 0


def _cell(episode: Episode) -> list[tuple[str, str]]:
    row = episode.row
    method = episode.method
    task = TASKS[row["task"]].title if row["task"] in TASKS else row["task"]
    rule = METHODS[method].rule if method in METHODS else ""
    who = who_title(method, episode.variant)
    return [
        ("cell", f"{task}, {who}, seed {row['seed']}, world {row['episode_seed']}"),
        ("operator", _operator(episode)),
        ("method", rule or f"not described: see the documentation of '{method}'"),
        *_operating_point(episode),
        ("key", episode.cell.key or f"none; read from {episode.cell.path}"),
    ]


def _operator(episode: Episode) -> str:
    """The operator and its severity in words."""
    name = episode.row["operator"]
    if name == UNIMPAIRED:
        return "unimpaired"
    words = name
    if name in OPERATORS:
        words = OPERATORS[name].title.lower()
    if episode.row["value"] is not None:
        words += f" {episode.row['value']:g}"
    if name in OPERATORS:
        words += f" ({OPERATORS[name].unit})"
    if is_auto(episode.cell.manifest):
        words += ", chosen on held-out worlds"
    return str(words)


def _operating_point(episode: Episode) -> Iterator[tuple[str, str]]:
    """The setting that was chosen for the assistant on held-out worlds, if one was."""
    point = episode.cell.setting("summary", "operating_point")
    if isinstance(point, str):
        text = printable(point)
        if point == "silent":
            text += ": no setting helped on held-out worlds, so every command is executed as it is"
        yield "operating point", text


def _cost_meaning(constants: Constants) -> str:
    if constants.bootstrap_cost:
        return (
            f"G^c: expected discounted cost if {_goes_on(constants)}, with the critic beyond "
            "the horizon (Eq. 9)"
        )
    within = "the horizon H"
    if constants.horizon is not None:
        within = f"the next {count(constants.horizon, 'decision')}"
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
    candidates = "" if constants.probe is None else f" of {constants.probe} that are tried"
    return (
        f"ΔG: expected gain in return by the best safe correction{candidates}, where the safety "
        "gate is silent (Eq. 12)"
    )


@dataclass(frozen=True)
class _Totals:
    """In how many decisions of an episode something happened."""

    intervened: int
    costly: int
    missed: int  # costly, and no gate fired
    late: int  # costly, and the assistant was late


def _totals(episode: Episode) -> _Totals:
    return _Totals(
        int(episode.intervened.sum()),
        int(episode.costly.sum()),
        int(episode.missed.sum()),
        int(episode.late.sum()),
    )


def _outcome(episode: Episode) -> Iterator[tuple[str, str]]:
    row = episode.row
    constants = episode.constants
    totals = _totals(episode)

    # Return, goals and length.
    success = "success" if row["success"] else "no success"
    outcome = f"return {plain(row['return'])}, {count(row['goals'], 'goal')} ({success})"
    outcome += f", {count(episode.decisions, 'decision')}"
    if constants.action_repeat is not None:
        outcome += f" of {count(constants.action_repeat, 'env step')}"
    if constants.decision_seconds is not None:
        outcome += f" ({constants.decision_seconds:g} s)"
    yield "outcome", outcome

    # Costs, and whether a gate fired before them.
    cost = count(row["cost"], "env step")
    if totals.costly:
        cost += f", in {count(totals.costly, 'decision')}"
        if episode.selective:
            despite_gate = totals.costly - totals.missed - totals.late
            cost += f": {totals.missed} missed, {despite_gate} although a gate fired"
        if totals.late:
            cost += f", {totals.late} while the assistant was late"
    yield "cost", cost

    # Interventions and searches.
    changed = "none"
    if totals.intervened:
        changed = f"{count(totals.intervened, 'decision')} ({row['int_rate']:.1%}, Int.)"
        mean = number(row["mag_int"])
        if mean is not None:
            changed += f", by {mean:.2f} on average (|a - a^H|)"
    yield "changed", changed
    case2 = number(row["case2"])
    if case2 is not None:
        yield "Case II", f"{case2:.0%} of the planner's iterations: too few safe candidates"

    # Decision times.
    p50 = number(row["decision_p50_ms"])
    p95 = number(row["decision_p95_ms"])
    if p50 is None or p95 is None:
        yield "time", "not recorded"
        return
    time = f"{ms(p50)} per decision (p50), {ms(p95)} (p95)"
    shared = episode.side_by_side
    if shared > 1:
        time += f"; the time of {shared} episodes decided side by side, divided by {shared}"
    yield "time", time


def _gate_counts(episode: Episode) -> Iterator[RenderableType]:
    thresholds = episode.thresholds
    signal = episode.signal
    late = bool((episode.gate == GATE_LATE).any())

    # The gates that the method has: gate, name, and the condition under which it fires.
    gates: list[tuple[int, str, str]] = []
    if episode.gated:
        safety = f"G^c > τ_c {short(thresholds.tau_c)}"
        if episode.variant == "task-only":
            safety = FIRES["off"]
        task = FIRES["off"]
        if episode.asks_task:
            task = f"ΔG > τ_r {short(thresholds.tau_r)}"
        gates += [(GATE_SAFETY, "safety", safety), (GATE_TASK, "task", task)]
    if not episode.gated or (episode.gate == GATE_METHOD).any():
        condition = "-"
        if episode.signal_limit is not None:
            condition = f"{signal.name} > {short(episode.signal_limit)}"
        gates.append((GATE_METHOD, who_title(episode.method), condition))
    gates.append((GATE_NONE, "none", "-"))
    if late:
        gates.append((GATE_LATE, "late", "no answer in time"))

    # How many decisions each has, and in how many of these the command was kept.
    rows = []
    for gate, name, condition in gates:
        fired = episode.gate == gate
        kept = 0
        if gate not in (GATE_NONE, GATE_LATE):
            kept = int((fired & ~episode.intervened).sum())
        rows.append(
            [
                name,
                condition,
                str(int(fired.sum())),
                f"{fired.mean():.1%}",
                str(kept) if kept else "-",
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
    """The order in which columns are dropped if there is no room, from 1; None: never."""

    @property
    def is_empty(self) -> bool:
        """Whether no cell says anything."""
        return set(self.cells) == {"-"}

    @property
    def width(self) -> int:
        """Characters of the longest cell."""
        return max(map(len, (self.title, *self.cells)))


def _fitting(columns: list[_Column], width: int) -> list[_Column]:
    """Empty columns in the order of `dropped` until the others fit; `table` leaves empty ones
    out.
    """
    kept = list(columns)
    turns = [place for place, column in enumerate(columns) if column.dropped is not None]
    for place in sorted(turns, key=lambda place: columns[place].dropped or 0):
        widths = [column.width for column in kept if not column.is_empty]
        if INDENT + sum(widths) + BETWEEN * (len(widths) - 1) > width:
            kept[place] = replace(kept[place], cells=["-"] * len(kept[place].cells))
    return kept


def _gate_of(episode: Episode, run: Run) -> str:
    """The gate of a run; for merged runs with how many decisions have it: `safety 12/15`."""
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
    """Return decision t as lines of at most `width` characters. Raises UsageError if the episode
    does not have it.
    """
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

    # WASP's gates and its plan.
    if facts.safety is not None and facts.task is not None:
        rows = []
        styles = []
        for look, gate, symbol, limit_symbol in (
            (LOOKS[GATE_SAFETY], facts.safety, "G^c", "τ_c"),
            (LOOKS[GATE_TASK], facts.task, "ΔG", "τ_r"),
        ):
            value, threshold = beside(gate.value, gate.threshold)
            rows.append(
                [look.kind, f"{symbol} {value}", f"{limit_symbol} {threshold}", FIRES[gate.state]]
            )
            styles.append(look.style if gate.state == "fired" else "")
        meanings = notes(_cost_meaning(episode.constants), _gain_meaning(episode.constants))
        yield from section(
            "Gates", table(["gate", "value", "threshold", "fires"], rows, styles), *meanings
        )
        yield from section("Plan", *_plan(episode, facts))

    # The signal of other methods.
    if facts.signal is not None:
        signal = episode.signal
        limit = episode.signal_limit
        # A guarded method's safety gate is asked only if its own vote is above the limit.
        fired = facts.gate == "method" or (facts.gate == "safety" and exceeds(facts.signal, limit))
        row = [
            signal.name,
            *beside(facts.signal, limit),
            short(episode.thresholds.tau_q),
            "yes" if fired else "no",
        ]
        drawn = table(
            ["signal", "value", "threshold", "τ_Q", "intervenes"],
            [row],
            [LOOKS[GATE_METHOD].style if fired else ""],
        )
        yield from section("Decision", drawn, *notes(f"{signal.name}: {signal.meaning}"))

    # What followed, and how long the decision took.
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
    did = "the command was executed"
    if facts.intervened:
        did = f"the command was changed by {facts.deviation:.3g}"
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
    if facts.safety is not None:
        return f"No gate fired: {did}."
    return f"{did.capitalize()}."


def _action(facts: Decision) -> RenderableType:
    how = "the command"
    if facts.intervened and facts.plan is None:
        how = "the method's own action"
    elif facts.intervened and facts.plan is not None:
        # Eq. 18: the sum is clipped to [-1, 1], and actions of the same force are made smallest.
        sums = [
            command + residual
            for command, residual in zip(facts.command, facts.plan.residuals[0], strict=True)
        ]
        how = "command and first correction"
        if any(abs(value) > 1 + 1e-4 for value in sums):
            how += ", cut off at the bounds"
        clipped = [min(max(value, -1.0), 1.0) for value in sums]
        pairs = zip(clipped, facts.executed, strict=True)
        if any(abs(value - executed) > 1e-4 for value, executed in pairs):
            how += ", as the least action of that force"
        how += " (Eq. 18)"
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
        search = {
            "safety": "not recorded",
            "task": "not recorded",
            "late": "none: the assistant was late",
            "method": "none: the method decided by its own rule",
        }.get(facts.gate, "none: no gate fired")
        yield fields([("search", search)])
        return
    if plan.searched:
        # Iterations that were cut off are stored first, before those that were made.
        cut = plan.safe.count(CUT_OFF)
        made = zip(plan.safe[cut:], plan.case2[cut:], strict=True)
        rows = [
            [str(i), str(safe), "II" if case2 else "I"] for i, (safe, case2) in enumerate(made, 1)
        ]
        yield table(["iteration", "safe (|F_s|)", "case"], rows)
        yield from notes(*(_case(episode, case2) for case2 in sorted(set(plan.case2[cut:]))))
        if cut:
            yield from notes(
                f"the search was cut off before its last {count(cut, 'iteration')}: its time was up"
            )
    else:
        search = (
            "none: the correction that the gate compared with the command is predicted safe, "
            "and is carried out"
        )
        yield fields([("search", search)])
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
                "with the search's rollouts the command alone was predicted safe, and no "
                "correction was worth more"
            )
        return [fields([("correction", f"none: {why}")])]
    # A sequence that no search found ends with its last correction that is not zero.
    steps = len(plan.residuals)
    if not plan.searched:
        steps = max(k for k, residual in enumerate(plan.residuals) if any(residual)) + 1
    rows = [["now", action(plan.residuals[0]), "executed"]]
    for k in range(1, steps):
        rows.append([f"+{k}", action(plan.residuals[k]), "not executed: planned again then"])
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
    """Whether the command alone is predicted to be safe, but not if the operator's error goes on at
    the decisions after it.
    """
    if facts.gate != "safety" or facts.safety is None:
        return False
    if plan.searched or plan.alone_cost is None:
        return False
    return exceeds(facts.safety.value, limit) and not exceeds(plan.alone_cost, limit)


def _predicted(episode: Episode, facts: Decision, plan: Planned) -> list[RenderableType]:
    limit = episode.thresholds.tau_c
    sequences = []
    if not plan.empty:
        sequences.append(("with the correction", plan.cost, plan.return_))
    alone = "command alone" if episode.constants.takeover else "commands alone"
    sequences.append((alone, plan.alone_cost, plan.alone_return))
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
    drawn = table(["predicted", "cost (G^c)", f"within τ_c {short(limit)}", "return (G^r)"], rows)
    remarks = []
    # A search uses rollouts of its own; only the printed WASP plans on those of its gates. Without
    # a search, the correction is one of those that the gates compared.
    if facts.gate == "safety" and plan.searched and episode.method != "printed":
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
    note = "cost: env steps with cost"
    if ahead.last - ahead.first + 1 < facts.window:
        note += f"; the episode ended before {facts.window} decisions"
    yield from notes(note)

    # What the gate expected beside what was observed, if both are the same quantity.
    comparable = constants.horizon == facts.window and constants.bootstrap_cost is False
    if (
        facts.safety is not None
        and facts.safety.value is not None
        and ahead.discounted is not None
        and comparable
    ):
        observed = "observed"
        if ahead.intervened:
            observed += ", with the interventions"
        expected = "the operator alone"
        if constants.takeover:
            first = "the command" if constants.vote is None else "IDA's action"
            expected = f"{first}, then the expert"
        rows = [
            [f"expected of {expected} (G^c)", short(facts.safety.value)],
            [observed, short(ahead.discounted)],
        ]
        yield table(["costly decisions", f"discounted (γ_c {short(constants.gamma_c)})"], rows)
