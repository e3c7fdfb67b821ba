"""Table `gains`: what the predictions of assistants with a model were worth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from wasp_cli.metrics.gains import CLUSTERS, RESAMPLES
from wasp_cli.report.gains import Foresight, Trust, trusted_groups
from wasp_cli.report.stats import Frame
from wasp_cli.report.summary import UNDEFINED, Interval, Value
from wasp_cli.report.tables import Column, Row, Table, assistant_title, task_title
from wasp_cli.report.tables.main import labels_of

COLUMNS = (
    Column("interventions", "Int.", digits=0),
    Column("worlds", "Worlds", digits=0),
    Column("predicted", "Predicted", digits=3, signed=True),
    Column("realised", "Realised", digits=3, signed=True),
    Column("slope", "Slope"),
    Column("rank", "Rank corr.", optional=True),
    Column("holds_from", "Holds from", digits=3),
    Column("tau_r", "τ_r", digits=3),
)
MEANINGS = (
    "Predicted and realised are means over branched interventions: return that the task gate's "
    "corrections gain, and costly decisions that the safety gate's save. Both are discounted by "
    "γ_r and γ_c.",
    "Slope is that of realised on predicted gains: 1 where predictions come true, 0 where they say "
    "nothing. Rank corr. is the correlation of the ranks.",
    "Predictions hold from the smallest predicted gain at or above which the mean realised gain "
    f"has an interval above 0, from {CLUSTERS} worlds on; n/a where they hold from none.",
    "Predicted and realised are not quite alike: a prediction has a value function behind the "
    "horizon, and follows the expert after the correction (WASP as printed: the operator's rule). "
    "The branches end after W decisions, and follow the operator.",
)


def gains_table(frame: Frame, foresight: Foresight) -> Table | None:
    """Make the table; None where no branched intervention has a prediction."""
    trusted = list(trusted_groups(frame, foresight))
    if not trusted:
        return None
    rows = [
        Row((*labels_of(trust.group), trust.quantity.title), tuple(_values(trust)))
        for trust in trusted
    ]
    return Table(
        "gains",
        "What the predictions were worth",
        ("Task", "Method", "Gate's gain"),
        COLUMNS,
        tuple(rows),
        tuple(_notes(foresight, trusted)),
        (*map(sentence, trusted), *MEANINGS),
        ranked=False,
    )


def _values(trust: Trust) -> Iterator[Value]:
    seeds = len(np.unique(trust.group.cells.seeds))

    def value(number: float | None, interval: Interval | None = None) -> Value:
        if number is None or math.isnan(number):
            return UNDEFINED
        return Value(number, n=seeds, ranked=False, interval=interval)

    yield value(float(trust.size))
    yield value(float(trust.worlds))
    yield value(trust.predicted)
    yield value(trust.realised, trust.interval)
    yield value(trust.flat.slope, trust.over_worlds(trust.flat.slope_interval))
    yield value(trust.flat.rank, trust.over_worlds(trust.flat.rank_interval))
    yield value(trust.holds)
    yield value(tau_r_of(trust))


def tau_r_of(trust: Trust) -> float | None:
    """Return the mean tau_r in force in the cells of a row, which gains of the task gate have to
    pass; None of cost saved.
    """
    if trust.quantity.key != "gain":
        return None
    in_force = [thresholds.tau_r for thresholds in trust.group.cells.thresholds]
    known = [tau_r for tau_r in in_force if tau_r is not None]
    return sum(known) / len(known) if known else None


def sentence(trust: Trust) -> str:
    """Say what the predictions of an assistant on a task were worth."""
    who = (
        f"{assistant_title(trust.group)} on {task_title(trust.group.task)}, {trust.quantity.title}"
    )
    means = f"predicted {trust.predicted:.3f}, realised {trust.realised:.3f}"
    if trust.interval is not None:
        means += f" [{trust.interval.low:.3f}, {trust.interval.high:.3f}]"
    said = [f"{who}: {means} (n = {trust.size})"]
    slope = trust.flat.slope
    low, high = trust.flat.slope_interval
    if not math.isnan(slope):
        limits = "" if math.isnan(low) else f" [{low:.2f}, {high:.2f}]"
        said.append(f"slope {slope:.2f}{limits}")
    if trust.holds is not None:
        said.append(f"it holds from a predicted {trust.holds:.3f} on")
    elif trust.worlds < CLUSTERS:
        said.append(f"{_worlds(trust.worlds)} are too few to say from where on it holds")
    else:
        said.append("it holds from no predicted gain on")
    return "; ".join(said) + "."


def _worlds(count: int) -> str:
    return "interventions in one world" if count == 1 else f"interventions in {count} worlds"


def _notes(foresight: Foresight, trusted: Sequence[Trust]) -> Iterator[str]:
    keys = {cell.key for trust in trusted for cell in trust.group.cells}
    shown = [foreseen for key, foreseen in foresight.cells.items() if key in keys]
    known = sum(len(foreseen.gate) for foreseen in shown)
    branched = sum(foreseen.branched for foreseen in shown)
    if known < branched:
        yield (
            f"{known} of {branched} branched interventions have a prediction here: published cells "
            "have the steps of their first episodes alone."
        )
    if any(trust.interval is not None for trust in trusted):
        yield (
            f"[low, high]: the middle 95 % of {RESAMPLES} resamples of the worlds; they cover "
            "other layouts, not retraining. Of two or three worlds they are their range."
        )
    for wrong in foresight.unread:
        yield f"Left out, since it does not read: {wrong}."
